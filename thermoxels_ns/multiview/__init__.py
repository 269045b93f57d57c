"""Evidence from photographs without a model: poses, depths by multi-view stereo, backdrops, gains and offsets."""
