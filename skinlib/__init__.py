"""Head in, skinned head out: learn to predict skin weights for heads."""

from skinlib.head import Head, HeadError, Skeleton

__version__ = "0.1.0"

__all__ = ["Head", "HeadError", "Skeleton", "__version__"]
