"""Makes the pictures of docs/reference/monitor.md: of `arctrack serve --simulated`, in a real browser.

python tests/arctrack/live/monitor/pictures.py docs/reference/pictures
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3]))

from browser import Page

from arctrack.cli.cell import LIVE_MM
from arctrack.live.monitor.monitor_process import run_monitor
from arctrack.live.monitor.options import MonitorOptions
from arctrack.live.serve.supervisor import SupervisedProcess, Supervisor
from arctrack.live.simulated_cell import REAL_TIME_PX
from arctrack.simulation.cell.weld.closed_loop import LoopPlan, setup_of

SIZE = (1280, 800)
SHOWN_S = 40.0


def main(folder: Path) -> None:
    """Run a simulated cell, and take a picture of its page, and one of its end."""
    folder.mkdir(parents=True, exist_ok=True)
    plan = LoopPlan(joint="lap", length_mm=LIVE_MM, rate_hz=10.0, size_px=REAL_TIME_PX)
    command = [sys.executable, "-c", "from arctrack.cli import main; main()", "serve", "--simulated"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run,
        tempfile.TemporaryDirectory() as profile,
    ):
        assert run.stdout is not None
        print(run.stdout.readline(), end="")
        options = MonitorOptions(
            str(run.pid),
            {1: setup_of(plan)},
            title="the simulated cell",
            job_names={1: "lap"},
            is_simulated=True,
        )
        with (
            Supervisor(print).running(SupervisedProcess("monitor", run_monitor, (options,))) as process,
            Page(Path(profile), *SIZE) as page,
        ):
            page.ask("Page.navigate", url=process.wait_ready())
            time.sleep(SHOWN_S)
            page.screenshot(folder / "monitor.png")
            run.terminate()
            run.wait()
            time.sleep(2.0)
            page.screenshot(folder / "monitor_ended.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
