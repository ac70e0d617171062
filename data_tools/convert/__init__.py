"""What researchers have on disk becomes a plain video folder: pictures, masks, camera, split, SMPL poses."""
