"""The pictures of the README, taken of what the product shows: `make screenshots STORE=results`.

The store must hold both embedded data sets (`make demo`). Pictures are taken in a headless Chromium and, of recordings, in the
Rerun viewer under Xvfb (Debian: chromium xvfb mesa-vulkan-drivers), and written with few colours, so that they stay small.
What does not belong here: anything that is drawn for the picture only.
"""

import argparse
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from assets_defs.plan import Unit
from pipeline.sinks.mlflow_outbox import Outbox
from pipeline.sinks.to_mlflow import VIEW
from pipeline.store import Store

HERE = Path(__file__).resolve().parent / "images"
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SHOWN = "so101_sim"
"""The data set of most pictures."""
PATIENCE_S = 300
COLOURS = 256


@dataclass(frozen=True)
class Scene:
    """What a picture is taken of: the store, a browser, and where Dagster and MLflow are served."""

    store: Store
    browser: Browser
    dagster: str
    mlflow: str

    def page(self, width: int, height: int, **context: Any) -> Page:
        page = self.browser.new_page(viewport={"width": width, "height": height}, **context)
        page.set_default_timeout(1000 * PATIENCE_S)
        return page


def report(scene: Scene, path: Path, width: int = 1300, height: int = 1015, **context: Any) -> None:
    page = scene.page(width, height, **context)
    page.goto((scene.store.folder(SHOWN, "benchmark_report") / "report.html").as_uri())
    page.locator("[data-chart] svg").first.wait_for(state="attached")
    page.screenshot(path=path)


def report_dark(scene: Scene, path: Path) -> None:
    report(scene, path, color_scheme="dark")


def report_phone(scene: Scene, path: Path) -> None:
    report(scene, path, 390, 844, device_scale_factor=2)


def graph(scene: Scene, path: Path) -> None:
    page = scene.page(1900, 2100)  # groups show how many of their assets are made where there is room for it
    page.goto(f"{scene.dagster}/asset-groups")
    outermost = [
        page.get_by_text(name, exact=True).locator("visible=true").last
        for name in ("data", "floor", "elsewhere", "looking")
    ]
    outermost[-1].wait_for()
    page.get_by_text("fetching statuses").first.wait_for(state="detached")
    page.wait_for_timeout(3000)  # the graph glides into its place
    left, top, bottom, right = (group.bounding_box() for group in outermost)
    width, height = right["x"] - left["x"] + 320, bottom["y"] - top["y"] + 140
    page.screenshot(path=path, clip={"x": left["x"] - 40, "y": top["y"] - 40, "width": width, "height": height})


def asset(scene: Scene, path: Path) -> None:
    page = scene.page(1500, 1000)
    page.goto(f"{scene.dagster}/assets/recipe_k32/predictions?view=partitions&partition={SHOWN}")
    page.get_by_text("Show Markdown").last.click()
    page.locator("img[src^='data:image/png']").first.wait_for()
    page.wait_for_timeout(1000)  # the picture fades in
    page.screenshot(path=path)


def mlflow(scene: Scene, path: Path) -> None:
    page = scene.page(1600, 1000)
    experiment = Outbox(scene.store, "sqlite").experiment_id(SHOWN)
    view = f"viewStateShareKey={VIEW}&compareRunsMode=CHART"
    page.goto(f"{scene.mlflow}/#/experiments/{experiment}/runs?{view}")
    page.get_by_text("first_step_mae").first.wait_for()
    for close in page.get_by_role("button", name="Close").all():  # MLflow's assistant, and what it says of shared views
        close.click()
    page.wait_for_timeout(3000)  # charts draw themselves one after another
    page.screenshot(path=path)


def rerun(scene: Scene, path: Path, key: str = "pusht_sim") -> None:
    recording = scene.store.folder(key, "rerun_recording") / "held_out.rrd"
    viewer = ["rerun", "--renderer", "vulkan", "--window-size", "1500x900", "--screenshot-to", str(path)]
    screen = ["xvfb-run", "-a", "-s", "-screen 0 1500x900x24"]
    subprocess.run(
        [*screen, *viewer, "--bind", "127.0.0.1", "--port", str(free_port()), str(recording)],
        env={**os.environ, "WGPU_BACKEND": "vulkan", "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
        timeout=2 * PATIENCE_S,
        check=True,
        capture_output=True,
    )


def rerun_so101(scene: Scene, path: Path) -> None:
    rerun(scene, path, "so101_sim")


OF_FILES: dict[str, Callable[[Scene, Path], None]] = {
    "report": report,
    "report_dark": report_dark,
    "report_phone": report_phone,
    "rerun": rerun,
    "rerun_so101": rerun_so101,
}
OF_SERVERS: dict[str, Callable[[Scene, Path], None]] = {"graph": graph, "asset": asset, "mlflow": mlflow}
"""Picture → how it is taken; those of the second kind need `demobench ui`."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def served(store: Store, wanted: bool) -> Iterator[tuple[str, str]]:
    """`demobench ui` over the store, as addresses of Dagster and MLflow; nothing where it is not wanted."""
    if not wanted:
        yield "", ""
        return
    ports = [str(free_port()) for _ in range(3)]
    options = [word for pair in zip(("--port", "--mlflow-port", "--files-port"), ports, strict=True) for word in pair]
    command = [sys.executable, "-m", "demobench.cli", "ui", "--store", str(store.root), *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    dagster, tracking = (f"http://127.0.0.1:{port}" for port in ports[:2])
    try:
        wait_for(f"{dagster}/server_info")
        wait_for(f"{tracking}/health")
        yield dagster, tracking
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=60)


def wait_for(address: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        with suppress(OSError), urllib.request.urlopen(address, timeout=5):
            return
        time.sleep(1)
    sys.exit(f"{address} did not answer within {PATIENCE_S} s")


def shrink(path: Path) -> None:
    """The picture with few colours: a quarter of the bytes. The rare ones are kept too: a policy is told by its colour.

    `kmeans` then moves each colour to the middle of what it stands for; else pale grounds turn pink.
    """
    method = Image.Quantize.MAXCOVERAGE
    few = Image.open(path).convert("RGB").quantize(COLOURS, method, kmeans=2, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def main() -> None:
    pictures = OF_FILES | OF_SERVERS
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path, help="a results folder with pusht_sim and so101_sim in it")
    parser.add_argument("--only", nargs="+", choices=pictures, default=list(pictures), help="some of the pictures")
    parser.add_argument("--out", type=Path, default=HERE, help="where to put them")
    asked = parser.parse_args()
    store, chromium = Store(asked.store), shutil.which("chromium")
    for key in ("pusht_sim", "so101_sim"):
        if store.made(store.folder(key, Unit("benchmark_report").asset)) is None:
            sys.exit(f"There is no report of {key} in {store.root}. Run `make demo` first, or name another store.")
    if chromium is None:
        sys.exit("There is no Chromium on this machine (Debian: apt-get install chromium).")
    asked.out.mkdir(parents=True, exist_ok=True)
    with served(store, bool(set(asked.only) & set(OF_SERVERS))) as addresses, sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=FLAGS, timeout=1000 * PATIENCE_S)
        for name in asked.only:
            path = asked.out.resolve() / f"{name}.png"
            pictures[name](Scene(store, browser, *addresses), path)
            shrink(path)
            print(f"{path}  {path.stat().st_size / 1e3:.0f} kB")
        browser.close()


if __name__ == "__main__":
    main()
