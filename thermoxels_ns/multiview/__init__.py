"""What photographs say without a model: depths by multi-view stereo."""
