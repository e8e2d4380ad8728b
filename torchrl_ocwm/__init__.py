"""Object-centric, goal-conditioned world models for robotic object positioning, as components for TorchRL."""

__version__ = "0.1.0"
