"""Any picture from disk, for looking at its stripes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.errors import FrameError
from wearline.messages import ResultCode

_CURE = "take an 8- or 16-bit grey or colour picture"


def read_picture(path: Path) -> NDArray[np.uint8] | NDArray[np.float32]:
    """An 8- or 16-bit grey or colour picture as [row, col]: uint8, or float32 in DN of 8 bits for 16-bit files.

    Of a colour picture the mean of the channels counts: a bright line fills all of them, its halo only one.

    Raises:
        FrameError: missing, truncated, or no picture (code 21).
    """
    where, code = str(path), int(ResultCode.BAD_FRAME)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FrameError(f"cannot be read ({error.strerror})", where, "name an image file", code) from error
    if not content:
        raise FrameError("is empty", where, _CURE, code)
    tail = content[-64:]
    if (content.startswith(b"\x89PNG") and b"IEND" not in tail) or (
        content.startswith(b"\xff\xd8\xff") and b"\xff\xd9" not in tail
    ):
        raise FrameError("is truncated", where, _CURE, code)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FrameError("cannot be decoded", where, _CURE, code) from error
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        raise FrameError("is no 8- or 16-bit picture, or is damaged", where, _CURE, code)
    if picture.ndim == 3:
        colours = picture[:, :, :3] if picture.shape[2] >= 3 else picture[:, :, :1]
        full = np.float32(255.0 if picture.dtype == np.uint8 else 65535.0)
        mean = np.rint(colours.astype(np.float32).mean(axis=2))
        picture = np.minimum(mean, full).astype(picture.dtype)
    if picture.dtype == np.uint8:
        return np.ascontiguousarray(picture, np.uint8)
    # Cameras put 10 to 14 bits into 16 without scaling them.
    top = max(int(picture.max()), 1)
    bits = next(b for b in (8, 10, 12, 14, 16) if top < 2**b)
    return np.asarray(picture.astype(np.float32) * np.float32(255.0 / (2**bits - 1)))
