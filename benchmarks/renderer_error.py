"""Error of the analytic renderer against the paper's literal steps, in intensity (0 to 255).

Prints one line of JSON: for each crop size and orientation, over all pixels of all robots' images
in random scenes, the mean absolute error, its mean over the pixels that are not black in both, the
mean error, and the worst pixel. It measures no times, so load does not matter.
"""

import argparse
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.machine import emit
from mrcdrl.common.arena import Scene, layout_for, literal_views, make_codec, training_start
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import UInt8Array

ORIENTATIONS = ("unrotated", "heading_up")
LIMIT = 0.5  # of intensity


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--crops", nargs="+", type=float, default=[60, 100, 150, 200, 300, 400, 600, 800]
    )
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--image", type=Path, help="also plot both side by side, as a PNG")
    arguments = parser.parse_args()
    base = {"num_robots": arguments.robots, "target_layout": "random"}
    scenes = random_scenes(ArenaConfig.model_validate(base), arguments.scenes, arguments.seed)
    configs = [
        ArenaConfig.model_validate({**base, "crop_px": crop, "orientation": orientation})
        for orientation, crop in product(ORIENTATIONS, arguments.crops)
    ]
    rows = [error(config, scenes) for config in configs]
    emit(
        {
            "bench": "renderer_error",
            "robots": arguments.robots,
            "scenes": arguments.scenes,
            "seed": arguments.seed,
            "limit": LIMIT,
            "above_limit": [
                f"{row['orientation']} {row['crop_px']:g}"
                for row in rows
                if row["mean_abs"] > LIMIT
            ],
            "errors": rows,
        }
    )
    if arguments.image is not None:
        plot(configs, scenes, arguments.image)


def random_scenes(config: ArenaConfig, num: int, seed: int) -> list[Scene]:
    """Draws scenes of poses and targets without overlap."""
    rng = np.random.default_rng(seed)
    starts = [training_start(config, layout_for(config, rng), rng) for _ in range(num)]
    return [Scene(start.robots, start.targets) for start in starts]


def error(config: ArenaConfig, scenes: list[Scene]) -> dict[str, object]:
    """Measures the errors of one crop size and orientation."""
    codec = make_codec(config)
    total = signed = shown = 0
    worst = (-1, {})
    for number, scene in enumerate(scenes):
        literal = literal_views(scene, config)
        analytic = codec.decode(codec.encode(scene))
        gaps = analytic.astype(int) - literal
        total += int(np.abs(gaps).sum())
        signed += int(gaps.sum())
        shown += int(np.count_nonzero(analytic | literal))
        at = np.unravel_index(int(np.abs(gaps).argmax()), gaps.shape)
        if abs(gaps[at]) > worst[0]:
            robot, row, column = map(int, at)
            place = {"scene": number, "robot": robot, "row": row, "column": column}
            pixel = {"analytic": int(analytic[at]), "literal": int(literal[at]), **place}
            worst = (int(abs(gaps[at])), pixel)
    pixels = len(scenes) * config.num_robots * config.view_px**2
    return {
        "crop_px": config.crop_px,
        "orientation": config.orientation,
        "mean_abs": round(total / pixels, 4),
        "mean_abs_where_not_black": round(total / shown, 3),
        "mean": round(signed / pixels, 4),
        "worst": worst[0],
        "worst_pixel": worst[1],
    }


def plot(configs: list[ArenaConfig], scenes: list[Scene], out: Path) -> None:
    """Plots a column for each configuration: literal, analytic, and their difference."""
    figure = Figure(figsize=(1.6 * len(configs), 5.2), dpi=110, layout="constrained")
    panels = figure.subplots(3, len(configs), squeeze=False)
    scene, robot = busiest(configs[0], scenes)
    for column, config in zip(panels.T, configs, strict=True):
        literal = literal_views(scene, config)[robot]
        codec = make_codec(config)
        analytic = codec.decode(codec.encode(scene))[robot]
        gap = analytic.astype(int) - literal
        for axes, image in zip(column, (literal, analytic), strict=False):
            axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        shown = column[2].imshow(gap, cmap="RdBu", vmin=-64, vmax=64)
        for axes in column:
            axes.set(xticks=[], yticks=[])
        column[0].set_title(f"{config.orientation}\n{config.crop_px:g} px", fontsize=8)
    for axes, label in zip(panels[:, 0], ("literal", "analytic", "difference"), strict=True):
        axes.set_ylabel(label)
    figure.colorbar(shown, ax=panels[2, -1], label="intensity")
    figure.savefig(out)


def busiest(config: ArenaConfig, scenes: list[Scene]) -> tuple[Scene, int]:
    """The scene and robot with the brightest image, of the first hundred scenes."""

    def brightness(views: UInt8Array) -> np.ndarray:
        return views.astype(int).sum(axis=(1, 2))

    sums = np.array([brightness(literal_views(scene, config)) for scene in scenes[:100]])
    number, robot = np.unravel_index(int(sums.argmax()), sums.shape)
    return scenes[int(number)], int(robot)


if __name__ == "__main__":
    main()
