"""Convert research data sets to video folders of the pipeline: images, masks, camera, split, SMPL poses."""
