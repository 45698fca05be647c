"""ROS messages -> images and calibrations, from bags and from the wire."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from suturetrack.calibration import CameraInfo, rig_from_camera_infos
from suturetrack.camera import StereoRig
from suturetrack.types import Image, InputError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUYV),
}
"""Channels, and how to get from them to BGR."""


def decode(message: Any, topic: str) -> Image:
    """The picture in an Image or a CompressedImage: (H, W, 3) BGR or (H, W) gray; raises InputError."""
    if hasattr(message, "format"):
        return _decode_compressed(message, topic)
    if message.encoding not in _ENCODINGS:
        raise InputError(
            f"topic {topic}: images are {message.encoding!r}; convert them to one of "
            f"{', '.join(_ENCODINGS)}"
        )
    channels, conversion = _ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    data = np.asarray(message.data, np.uint8).ravel()
    if not 0 < width * channels <= step or height < 1 or data.size < height * step:
        raise InputError(
            f"topic {topic}: {data.size} bytes in rows of {step} are no {width}x{height} "
            f"{message.encoding} image"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    image = rows if channels == 1 else rows.reshape(height, width, channels)
    if conversion is None:
        return np.ascontiguousarray(image)
    return cv2.cvtColor(np.ascontiguousarray(image), conversion)


def stamp_ns(message: Any) -> int:
    """The stamp of a message's header, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def rig_of_messages(left: Any, right: Any, unit: str | None, where: str) -> StereoRig:
    """The rig of two camera_info messages; raises InputError."""
    infos = [
        _camera_info(message, f"{where}: {side}")
        for message, side in ((left, "left"), (right, "right"))
    ]
    return rig_from_camera_infos(infos[0], infos[1], unit, where)


def _decode_compressed(message: Any, topic: str) -> Image:
    data = np.asarray(message.data, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise InputError(f"topic {topic}: {message.format!r} cannot be decoded; use jpeg or png")
    if image.dtype != np.uint8:
        raise InputError(f"topic {topic}: images are {image.dtype}; convert them to 8 bit")
    return np.ascontiguousarray(image[..., :3]) if image.ndim == 3 else image


def _camera_info(message: Any, where: str) -> CameraInfo:
    # ROS 1 has capitals.
    d, k, r, p = (
        getattr(message, n, None) if hasattr(message, n) else getattr(message, n.upper())
        for n in "dkrp"
    )
    roi = message.roi
    cropped = roi.x_offset or roi.y_offset or roi.width not in (0, message.width)
    if max(message.binning_x, message.binning_y) > 1 or cropped:
        raise InputError(
            f"{where} images are binned or cropped; give the calibration of such images"
        )
    return CameraInfo(
        (int(message.width), int(message.height)),
        str(message.distortion_model),
        np.asarray(d, float),
        np.asarray(k, float).reshape(3, 3),
        np.asarray(r, float).reshape(3, 3),
        np.asarray(p, float).reshape(3, 4),
    )
