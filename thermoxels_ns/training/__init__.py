"""The nerfstudio model, its losses, optimisers and the course of a training."""
