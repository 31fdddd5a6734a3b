"""Run by Blender: `blender --background --python blender_passes.py -- FILE FOLDER`.

Opens an EXR file as a compositor's image and saves each of its passes as an EXR file of its
own in FOLDER, which Blender numbers by frame: `depth0001.exr`.
"""

import sys

import bpy


def main(path, folder):
    scene = bpy.context.scene
    scene.use_nodes = True  # And no node of the 3D scene: nothing but these two is rendered.
    nodes, links = scene.node_tree.nodes, scene.node_tree.links
    nodes.clear()
    image = nodes.new("CompositorNodeImage")
    image.image = bpy.data.images.load(path)
    files = nodes.new("CompositorNodeOutputFile")
    files.base_path = folder
    files.format.file_format = "OPEN_EXR"
    files.format.color_depth = "32"
    files.file_slots.clear()
    for output in image.outputs:
        if output.enabled:
            files.file_slots.new(output.name)
            links.new(output, files.inputs[output.name])
    bpy.ops.render.render()


main(*sys.argv[sys.argv.index("--") + 1 :])
