"""A GIF of an episode, small enough for a README."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from phihp_torchrl.config import names_file
from phihp_torchrl.evaluation.episode import Episode

_COLORS = 32


def write_gif(
    episode: Episode,
    path: str | os.PathLike[str],
    *,
    size: int = 240,
    max_bytes: int = 1_000_000,
) -> Path:
    """Write the pictures of an episode as a GIF in real time, with at most 20 frames a second.

    If the file would be too large, it gets fewer frames for each second, and then smaller ones.

    Args:
        episode: an episode of :func:`~phihp_torchrl.evaluation.play_episode` with ``render=True``.
        path: the file to write; its directory is made if absent.
        size: height in pixels; the width keeps the shape of the pictures.
        max_bytes: largest size of the file.

    Returns:
        The path.

    Raises:
        ValueError: if the episode has no pictures, or the GIF cannot be made small enough.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from phihp_torchrl import get_task
        >>> steps = np.zeros((3, 2)), np.zeros((2, 1)), np.zeros(2)
        >>> frames = np.zeros((3, 40, 40, 3), dtype=np.uint8)
        >>> episode = Episode(get_task("pendulum"), *steps, False, frames, frame_steps=1)
        >>> with tempfile.TemporaryDirectory() as place:
        ...     write_gif(episode, f"{place}/episode.gif", size=20).read_bytes()[:6]
        b'GIF89a'
    """
    if not len(episode.frames):
        raise ValueError("episode: expected pictures, got none; play it with render=True.")
    if size < 16:
        raise ValueError(f"size: expected at least 16 pixels, got {size}.")
    duration = 1000.0 * episode.frame_steps * episode.task.time_step
    # A task with long time steps (Acrobot: 0.2 s) is shown faster than in real time.
    duration = min(duration, 50.0)
    stride, height = 1, size
    while True:
        frames = [_picture(f, height) for f in episode.frames[::stride]]
        data = _encode(frames, duration * stride)
        if len(data) <= max_bytes:
            break
        if stride < 4:
            stride *= 2
        elif height >= 120:
            height //= 2
        else:
            raise ValueError(
                f"max_bytes: expected at least {len(data)} for this episode, got {max_bytes}."
            )
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    with names_file(path):
        temporary.write_bytes(data)
        os.replace(temporary, path)
    return path


def _picture(frame: object, height: int) -> Image.Image:
    image = Image.fromarray(frame)  # type: ignore[arg-type]
    width = round(image.width * height / image.height)
    image = image.resize((width, height), Image.Resampling.BILINEAR, reducing_gap=1.5)
    return image.quantize(_COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def _encode(frames: Sequence[Image.Image], duration: float) -> bytes:
    buffer = io.BytesIO()
    # GIFs count in hundredths of a second; players slow down what is under 20 ms.
    frames[0].save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=list(frames[1:]),
        duration=max(20, 10 * round(duration / 10)),
        loop=0,
        optimize=True,
    )
    return buffer.getvalue()
