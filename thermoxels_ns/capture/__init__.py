"""From camera files to a scene: pairs, poses, scale, rig, drift, and the folder that the dataparser reads."""
