"""From a stereo pair to the ridge vector field (Section III)."""

from suturetrack.segmentation.config import SegmentationConfig
from suturetrack.segmentation.segmenter import Segmenter, joined
from suturetrack.segmentation.sight import gaussian_kernel

__all__ = ["SegmentationConfig", "Segmenter", "gaussian_kernel", "joined"]
