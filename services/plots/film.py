"""Films of episodes: the arena, what each robot sees of it, and a caption.

Invariants: frames are uint8 BGR of one size. A film is H.264, which every player shows, or a GIF,
which every page shows: half as wide and high, every third frame. Neither is held in memory.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Literal

import av
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.messages.trajectory import UInt8Array
from mrcdrl.services.plots.figures import check_suffix

BACKGROUND = 24
CAPTION_PX, LABEL_PX, GAP_PX = 40, 22, 12
MAX_PANEL_PX = 560  # width for the robots' views
FONT = "fonts/ttf/DejaVuSans.ttf"
BRIGHTENED = "robots' images brightened"
_BRIGHTER = np.rint(255 * np.sqrt(np.arange(256) / 255)).astype(np.uint8)


def write_film(path: Path, frames: Iterable[UInt8Array], fps: int) -> int:
    """Write the frames (uint8 BGR [H, W, 3], all of one size); return the number written.

    The suffix chooses the format, .mp4 or .gif. An odd height or width loses its last row or
    column. Raises MrcdrlError for another suffix, for no frames, for frames of different sizes,
    and when the file or the encoder fails.
    """
    check_suffix(path, SUFFIXES)
    encoding = _FORMATS[path.suffix]
    num_frames = 0
    shape: tuple[int, ...] | None = None
    try:
        with av.open(str(path), "w") as container:
            stream = container.add_stream(encoding.codec, rate=Fraction(fps, encoding.every))
            stream.pix_fmt = encoding.pixels
            stream.options = encoding.options
            for frame in islice(frames, 0, None, encoding.every):
                height, width = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
                image = encoding.image(np.ascontiguousarray(frame[:height, :width]))
                if shape is None:
                    shape = frame.shape
                    stream.height, stream.width = image.height, image.width
                if frame.shape != shape:
                    raise MrcdrlError(
                        f"film {path}: a frame is {frame.shape}, the first one {shape}"
                    )
                container.mux(stream.encode(image))
                num_frames += 1
            if num_frames:
                container.mux(stream.encode())
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise MrcdrlError(f"film {path} cannot be written: {error}") from error
    if not num_frames:
        path.unlink(missing_ok=True)
        raise MrcdrlError(f"film {path} has no frames")
    return num_frames


@dataclass(frozen=True, slots=True)
class _Format:
    """Encoding of a film."""

    codec: Literal["libx264", "gif"]
    pixels: str  # format of the encoder's images
    options: dict[str, object]
    every: int  # one frame in so many is kept
    image: Callable[[UInt8Array], av.VideoFrame]  # takes a frame of even size


def _whole(frame: UInt8Array) -> av.VideoFrame:
    return av.VideoFrame.from_ndarray(frame, format="bgr24")


def _small(frame: UInt8Array) -> av.VideoFrame:
    """The frame at half its size, in the palette's colours."""
    half = Image.fromarray(frame[..., ::-1]).reduce(2)
    indices = half.quantize(palette=_palette(), dither=Image.Dither.NONE)
    argb = np.insert(_colours(), 0, 255, axis=1)
    return av.VideoFrame.from_ndarray((np.asarray(indices), argb), format="pal8")  # type: ignore[arg-type]


@cache
def _colours() -> UInt8Array:
    """Intensities, and red and blue on black and on white; RGB [256, 3]."""
    intensities = np.linspace((0, 0, 0), (255, 255, 255), 128)
    ramps = [
        np.linspace(paint, ground, 32)
        for paint in ((255, 0, 0), (0, 0, 255))
        for ground in ((0, 0, 0), (255, 255, 255))
    ]
    return np.concatenate([intensities, *ramps]).astype(np.uint8)


@cache
def _palette() -> Image.Image:
    image = Image.new("P", (1, 1))
    image.putpalette(_colours().tobytes())
    return image


_FORMATS = {
    ".mp4": _Format("libx264", "yuv420p", {"crf": "20"}, 1, _whole),
    ".gif": _Format("gif", "pal8", {}, 3, _small),
}
SUFFIXES = tuple(_FORMATS)


def compose_frame(
    arena_bgr: UInt8Array, views: UInt8Array, caption: str, note: str = ""
) -> UInt8Array:
    """One frame: the arena on the left, the robots' views on the right, caption and note below.

    The views are enlarged and brightened: a target's intensity is 29 of 255, and hard to see.

    arena_bgr: uint8 [S, S, 3]. views: uint8 [K, V, V], intensities. Returns uint8 BGR [H, W, 3] of
    even size, equal for equal shapes.
    """
    size = arena_bgr.shape[0]
    panel = _panel(views, size)
    height, width = size + CAPTION_PX, arena_bgr.shape[1] + panel.shape[1]
    frame = np.full((height + height % 2, width + width % 2, 3), BACKGROUND, np.uint8)
    frame[:size, : arena_bgr.shape[1]] = arena_bgr
    frame[:size, arena_bgr.shape[1] : width] = panel
    below = frame[size : size + CAPTION_PX, :width]
    below[:] = _text([caption], width, CAPTION_PX, 18)
    room = width - _length(caption, 18) - 3 * GAP_PX
    beside = [f"{note} · {BRIGHTENED}", BRIGHTENED] if note else [BRIGHTENED]
    said = _text(beside, max(0, room), CAPTION_PX, 13, right=True)
    below[:, width - said.shape[1] :] = said
    return frame


def _panel(views: UInt8Array, height: int) -> UInt8Array:
    """The views in a grid, enlarged by the largest whole factor, with a label above each."""
    num, side = views.shape[:2]
    columns, scale = _grid(num, side, height)
    large = side * scale
    panel = np.full((height, GAP_PX + columns * (large + GAP_PX), 3), BACKGROUND, np.uint8)
    rows = -(-num // columns)
    pitch = LABEL_PX + large + GAP_PX
    top = max(0, (height - rows * pitch + GAP_PX) // 2)
    for k, view in enumerate(views):
        y = top + k // columns * pitch
        x = GAP_PX + k % columns * (large + GAP_PX)
        label = [f"robot {k + 1} sees", f"robot {k + 1}", f"{k + 1}"]
        panel[y : y + LABEL_PX, x : x + large] = _text(label, large, LABEL_PX, 13)
        enlarged = _BRIGHTER[view].repeat(scale, axis=0).repeat(scale, axis=1)[:, :, None]
        room = panel[y + LABEL_PX : y + LABEL_PX + large, x : x + large]
        room[:] = enlarged[: room.shape[0]]
    return panel


def _grid(num: int, side: int, height: int) -> tuple[int, int]:
    """Number of columns and whole factor that make the views largest."""

    def scale(columns: int) -> int:
        rows = -(-num // columns)
        down = (height - (rows - 1) * GAP_PX) // rows - LABEL_PX
        across = (MAX_PANEL_PX - GAP_PX) // columns - GAP_PX
        return min(down // side, across // side)

    columns = max(range(1, max(2, num + 1)), key=scale)
    return columns, max(1, scale(columns))


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / FONT), size)


def _length(text: str, size: int) -> int:
    return math.ceil(_font(size).getlength(text))


def _text(
    texts: Sequence[str], width: int, height: int, size: int, *, right: bool = False
) -> UInt8Array:
    """The first text that fits, light on the background, uint8 [height, width, 3]; none if none
    does."""
    image = Image.new("L", (width, height), BACKGROUND)
    margin = GAP_PX // 2
    fitting = [text for text in texts if _length(text, size) + 2 * margin <= width]
    if fitting:
        at, anchor = (width - margin, "rm") if right else (margin, "lm")
        draw = ImageDraw.Draw(image)
        draw.text((at, height // 2), fitting[0], fill=235, font=_font(size), anchor=anchor)
    return np.repeat(np.asarray(image, dtype=np.uint8)[:, :, None], 3, axis=2)
