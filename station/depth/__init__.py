"""From raw depth frames to one clean cloud of the person: the paper's "average and filter" step."""

from station.depth.preprocess import (
    CameraView,
    Finding,
    PointCloud,
    Preprocessed,
    Volume,
    preprocess,
)

__all__ = ["CameraView", "Finding", "PointCloud", "Preprocessed", "Volume", "preprocess"]
