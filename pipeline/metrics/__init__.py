"""Quality metrics: images against held-out frames, surfaces against ground truth, and the quality of one mesh.

Pure functions on arrays. `images` follows the evaluation protocol of the literature (8-bit images composited on white)
and adds the same scores on the foreground pixels alone. `surfaces` measures distances in mm and angles in degrees.
`health` measures the quality of a single mesh.
"""
