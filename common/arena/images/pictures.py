"""Pictures of other worlds, made into the images that the network sees."""

import numpy as np

from mrcdrl.common.messages.trajectory import UInt8Array


def is_picture(shape: tuple[int, ...], dtype: object) -> bool:
    """Whether observations of this shape and dtype are pictures that `image_of` takes."""
    channels = shape[2:] in ((), (1,), (3,))
    return len(shape) in (2, 3) and channels and min(shape[:2]) > 0 and dtype == np.uint8


def image_of(picture: UInt8Array, view_px: int) -> UInt8Array:
    """The image uint8 [V, V] of a picture uint8 [H, W], [H, W, 1] or, in RGB, [H, W, 3].

    Converted to intensity and resized by area, as the paper does; other shapes are squeezed.
    """
    import cv2  # slow, and of an extra: only worlds of others need it here

    if picture.shape[2:] == (3,):
        gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    else:
        gray = picture.reshape(picture.shape[:2])
    if gray.shape != (view_px, view_px):
        gray = cv2.resize(gray, (view_px, view_px), interpolation=cv2.INTER_AREA)
    return np.asarray(gray, np.uint8)
