"""How every picture of docs/images is made: `make pictures`, in the root of the repository.

Each published study and board has one, and `episode.gif` plays an agent; the others are of the pages by hand.

A picture of published entries carries a mark, a hash of these entries and of its command. Where entries have changed
since, `tests/docs/test_pictures.py` says that it is stale. Pictures of runs that are not published stay as they are;
they are listed with the command that trains the runs and draws them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageSequence
from PIL.PngImagePlugin import PngInfo
from tables import FAMILY, PAIRS, ROOT, TOGETHER, short_names

from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.leaderboard.shelf.published import AGENTS, encode_record

IMAGES = ROOT / "docs" / "images"
MARK = "qrlsuite-made-from"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@dataclass(frozen=True)
class Plot:
    """A picture, or an animation, that a command makes of published entries.

    Attributes
    ----------
    entries:
        Patterns of the folders, below leaderboard/, that it shows.
    """

    command: str
    entries: tuple[str, ...]


@dataclass(frozen=True)
class Screenshot:
    """The page that a command writes of published entries, in a browser.

    Attributes
    ----------
    width, height:
        Of the picture, in pixels.
    heading:
        Where the picture begins; without one, at the top of the page.
    """

    command: str
    entries: tuple[str, ...]
    width: int
    height: int
    heading: str = ""


@dataclass(frozen=True)
class Unpublished:
    """A picture of runs that are not published: a command that trains them, if it is one, and the one that draws it."""

    command: str
    program: str = "qrlsuite"
    trained: str = ""


Picture = Plot | Screenshot | Unpublished
BOARD = "leaderboard --published --task beam6g --format html"
PICTURES: dict[str, Picture] = {
    "field.png": Plot("plot field --task beam6g", ()),
    "cartpole.png": Plot(
        "plot curves --task cartpole --published --entry reinforce-mlp-08663f8a --entry reinforce-vqc-native-f64996c4",
        ("entries/cartpole/reinforce*",),
    ),
    "board-beam6g.png": Plot(
        "plot curves --task beam6g --published --entry 'mlp width=16' --entry 'mlp width=16 lr=0.002' "
        "--entry 'mlp width=32' --entry 'mlp width=64' --entry 'vqc-native qubits=6' --entry 'vqc-native qubits=10'",
        ("entries/beam6g/*",),
    ),
    **{
        f"board-{task}.png": Plot(
            shlex.join(
                ["plot", "curves", "--task", task, "--published"]
                + [
                    word
                    for entry, name in short_names(task).items()
                    for word in ("--label", f"{entry}={name}")
                ]
            ),
            (f"entries/{task}/*",),
        )
        for task in PAIRS
    },
    "episode.gif": Plot(
        "play 'vqc-native qubits=10' --task beam6g --published --episode 3",
        ("entries/beam6g/ddqn-vqc-native-*",),
    ),
    **{
        f"study-{name}.png": Plot(f"plot pairs --study {name}", (f"plans/{name}", f"plans/{name}/*/*"))
        for name in published_studies.names(begun=True)
    },
    "diagnose-circuit.png": Plot("diagnose ansatz iqp qubits=2:16:2", ()),
    "diagnose-agents.png": Plot(
        "diagnose 'vqc-native qubits=6' --task beam6g --published", ("entries/beam6g/ddqn-vqc-native-*",)
    ),
    "report-narrow.png": Screenshot(BOARD, ("entries/beam6g/*",), 390, 1000),
    "report-pairs.png": Screenshot(BOARD, ("entries/beam6g/*",), 1160, 1000, "Who outperforms whom"),
    "report-wide.png": Screenshot(BOARD, ("entries/beam6g/*",), 1400, 1300),
    "predictors.png": Unpublished(
        "benchmarks/predictors.py --qubits 6 8 --out predictors.png", program="python"
    ),
    "policies.png": Unpublished(  # after `study run fig8 --seeds 30`: it plays agents that were trained here
        "evaluate 'mlp width=64' 'vqc-native qubits=14' --best 10 --episodes 1000 --out policies.png"
    ),
    "tuning-sensitivity.png": Unpublished(
        "benchmarks/tuning.py --stored runs/tuning --repetitions 0 --out tuning-sensitivity.png",
        program="python",
    ),
    "study-deploy-errors.png": Unpublished(
        "plot errors --study deploy", trained="study run deploy --seeds 20"
    ),
    "study-deploy-shots.png": Unpublished("plot shots --study deploy", trained="study run deploy --seeds 20"),
    **{
        f"study-shots-{kind}.png": Unpublished(
            f"plot {kind} --study shots", trained="study run shots --seeds 20 --epochs 30"
        )
        for kind in ("costs", "curves")
    },
    "study-ablation-layers.png": Plot(
        "plot layers --study ablation --published --seeds 20",
        ("entries/beam6g/ddqn-vqc-native-*", "unranked/beam6g/ddqn-vqc-native-*"),
    ),
    "study-antennas-scaling.png": Plot(
        "plot scaling --study antennas --published --seeds 20", ("unranked/beam6g-a?-?/*",)
    ),
    "study-degree-scaling.png": Plot(
        "plot scaling --study degree --published --seeds 20",
        ("entries/beam6g/*", "entries/beam6g-degree[456]/*"),
    ),
    "study-fidelity-text.png": Plot(
        "plot text --study fidelity --published",
        ("unranked/beam6g/*",),
    ),
    "study-fig1-surface.png": Plot("plot surface --study fig1 --published --seeds 30", ("entries/beam6g/*",)),
    "study-fig6-bars.png": Plot("plot bars --study fig6 --published --seeds 30", ("entries/beam6g/*",)),
    "study-fig7-scaling.png": Plot("plot scaling --study fig7 --published --seeds 30", ("entries/beam6g/*",)),
    **{
        f"study-{name}-tasks.png": Plot(
            f"plot pairs {' '.join(f'--study {place}{each}' for each in TOGETHER[name])}",
            tuple(f"{folder}/{each}{below}" for each in TOGETHER[name] for below in ("", "/*/*")),
        )
        for name, folder, place in (
            ("advantage", "plans", ""),
            ("equal-size", "plans", ""),
            ("equal-size-ppo", "plans", ""),
            (FAMILY, FAMILY, f"leaderboard/{FAMILY}/"),
        )
    },
    "study-ppo-bars.png": Plot("plot bars --study ppo --published --seeds 20", ("unranked/beam6g/ppo-*",)),
    "episode-pulse.png": Plot("plot episode seed=2 --task pulse", ()),
    "episode-vqe.png": Plot("plot episode seed=2 --task vqe-ising", ()),
}


def made_from(picture: Plot | Screenshot) -> str:
    """Return the mark of a picture: a hash of its command and of the published entries that it shows."""
    digest = hashlib.sha256(repr(picture).encode())
    published = ROOT / "leaderboard"
    for path in sorted(path for pattern in picture.entries for path in published.glob(f"{pattern}/[!.]*")):
        if path.is_file() and path.name != AGENTS:
            digest.update(path.relative_to(published).as_posix().encode())
            digest.update(_shown(path))
    return digest.hexdigest()[:16]


def _shown(path: Path) -> bytes:
    """Return a published file as it would be without agents, which no picture of published entries shows."""
    content = path.read_bytes()
    if path.name != "entry.json":
        return content
    record = json.loads(content)
    record["published"].pop("agents", None)
    return encode_record(record)


def mark_of(path: Path) -> str | None:
    """Return the mark that a picture carries."""
    with Image.open(path) as image:
        comment = image.info.get("comment", b"").decode()
        return image.info.get(MARK) or comment.removeprefix(f"{MARK} ") or None


def main(chosen: Sequence[str]) -> None:
    """Make the chosen pictures of published entries, by default all, and name the others."""
    with browser() as chromium, tempfile.TemporaryDirectory() as folder:
        for name in chosen or PICTURES:
            picture = PICTURES[name]
            if isinstance(picture, Unpublished):
                print(f"kept {name}: its runs are not published; {picture.program} {picture.command}")
                continue
            made = Path(folder, name)
            if isinstance(picture, Plot):
                _run(picture.command, made)
            elif chromium is None:
                print(f"kept {name}: no browser on the path ({', '.join(BROWSERS)}), or no playwright")
                continue
            else:
                page = Path(folder, hashlib.sha256(picture.command.encode()).hexdigest() + ".html")
                if not page.exists():
                    _run(picture.command, page)
                _photograph(chromium, page, picture, made)
            _mark(made, made_from(picture), IMAGES / name)
            print(f"made {name}: qrlsuite {picture.command}")


def _run(command: str, out: Path) -> None:
    """Run a command of the suite, which sees published entries and no runs of its user."""
    place = ["--runs", str(out.parent / "runs"), "--out", str(out)]
    words = [sys.executable, "-m", "qrlsuite", *shlex.split(command), *place]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


def _mark(made: Path, mark: str, place: Path) -> None:
    """Store a picture in few colors with its mark; of an animation every second frame."""
    with Image.open(made) as image:
        if place.suffix == ".gif":
            images = [each.convert("RGB") for each in ImageSequence.Iterator(image)][::2]
            colors = images[-1].quantize(128, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
            first, *rest = (each.quantize(palette=colors, dither=Image.Dither.NONE) for each in images)
            comment = f"{MARK} {mark}".encode()
            shown = {"duration": 100, "loop": 0, "optimize": True}
            first.save(place, save_all=True, append_images=rest, comment=comment, **shown)
            return
        info = PngInfo()
        info.add_text(MARK, mark)
        image.convert("RGB").quantize(128, dither=Image.Dither.NONE).save(place, pnginfo=info, optimize=True)


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    """Start an installed browser; None where there is none."""
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        path = None
    if path is None:
        yield None
        return
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield chromium
        chromium.close()


def _photograph(chromium: Any, page: Path, picture: Screenshot, out: Path) -> None:
    tab = chromium.new_page(viewport={"width": picture.width, "height": 900})
    tab.set_default_timeout(300_000)
    tab.goto(page.as_uri())
    top = 0.0
    if picture.heading:
        top = tab.get_by_role("heading", name=picture.heading).first.bounding_box()["y"] - 12
    tab.screenshot(
        path=str(out),
        full_page=True,
        clip={"x": 0, "y": top, "width": picture.width, "height": picture.height},
    )
    tab.close()


if __name__ == "__main__":
    main(sys.argv[1:])
