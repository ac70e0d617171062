"""How good a result is: images against held-out frames, surfaces against truth, a mesh against itself.

Pure functions on arrays. `images` is the protocol of the literature (8-bit, full image on white) and its honest
companions on the body alone; `surfaces` compares geometry in mm and degrees; `health` looks at one mesh.
"""
