"""Run by Blender: `blender --background --python blender_passes.py -- FILE FOLDER`.

Opens an EXR file as a compositor's image and saves each of its passes as an EXR file of its
own in FOLDER, `depth.exr`, to which Blender may add the frame's number.
"""

import sys

import bpy


def main(path, folder):
    scene = bpy.context.scene
    # No node of the 3D scene: nothing but these two is rendered.
    if bpy.app.version >= (5, 0):
        tree = bpy.data.node_groups.new("passes", "CompositorNodeTree")
        scene.compositing_node_group = tree
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
    image = tree.nodes.new("CompositorNodeImage")
    image.image = bpy.data.images.load(path)
    files = tree.nodes.new("CompositorNodeOutputFile")
    if bpy.app.version >= (5, 0):
        files.directory, files.file_name = folder, ""
        files.format.media_type = "IMAGE"
        add = lambda output: files.file_output_items.new("RGBA", output.name)
    else:
        files.base_path = folder
        files.file_slots.clear()
        add = lambda output: files.file_slots.new(output.name)
    files.format.file_format = "OPEN_EXR"
    files.format.color_depth = "32"
    for output in image.outputs:
        if output.enabled:
            add(output)
            tree.links.new(output, files.inputs[output.name])
    bpy.ops.render.render()


main(*sys.argv[sys.argv.index("--") + 1 :])
