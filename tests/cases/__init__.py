"""The cases in which methods fail, effect by effect, and their registry."""
