#!/usr/bin/env python3
"""Runs this program and COLMAP on the same photographs, one after the other, and prints a Markdown table of both.

usage: benches/compare/compare.py [--datasets FOLDER] [--only NAME,NAME] [--out target/compare]
                                  [--binary target/release/multistage] [--reuse-colmap] [--threads N]

Needs `cargo build --release` and a Python with numpy and pycolmap (pip install pycolmap). A data set is a folder with
`images/`, and `gt/poses.txt` where reference poses are known. Both programs run with their default options, without
hints, on the CPU; COLMAP matches exhaustively and maps incrementally. --reuse-colmap takes COLMAP's figures from an earlier
run where there are any: right for quality, and for time only on a computer that is as busy as it was then.

Time: of our whole process; of COLMAP's three stages without the start of Python. Memory: the largest resident set, as each
process tells of itself.
AUC: `multistage evaluate`. Wild: see model_quality.py. Ratios are ours to COLMAP's.
"""
import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import model_quality

HERE = Path(__file__).resolve().parent
HEADER = ["set", "program", "wall s", "CPU s", "peak MB", "registered", "AUC@1 / 3 / 5", "points 3+", "error px", "wild %"]


def measured(command, log):
    """Runs a command with its output in the file `log`: exit status, wall and CPU seconds."""
    with open(log, "wb") as output:
        start = time.monotonic()
        process = subprocess.Popen([str(part) for part in command], stdout=output, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    return {
        "status": process.returncode,
        "wall_s": time.monotonic() - start,
        "cpu_s": usage.ru_utime + usage.ru_stime,
    }


def with_quality(figures, sparse, reference, binary):
    """Adds what the largest model below `sparse` is worth."""
    folder = model_quality.largest_model(sparse)
    figures["model"] = model_quality.measure(folder) if folder else None
    figures["auc_percent"] = None
    if folder and (reference / "poses.txt").exists():
        command = [str(binary), "evaluate", str(folder), str(reference), "--json"]
        answer = subprocess.run(command, capture_output=True, text=True, check=True)
        figures["auc_percent"] = json.loads(answer.stdout)["auc_percent"]
    return figures


def run_ours(data, out, arguments):
    out.mkdir(parents=True, exist_ok=True)
    command = [arguments.binary, "reconstruct", data / "images", "--out", out / "result", "--quiet"]
    if arguments.threads:
        command += ["--threads", arguments.threads]
    figures = measured(command, out / "log.txt")
    if figures["status"] not in (0, 3):
        raise SystemExit(f"{data.name}: multistage failed, see {out / 'log.txt'}")
    report = json.loads((out / "result" / "report.json").read_text())
    figures["peak_bytes"] = report["peak_rss_bytes"]
    figures["stages"] = [
        {key: stage[key] for key in ("name", "iteration", "wall_s", "cpu_s")} for stage in report["stages"]
    ]
    return with_quality(figures, out / "result" / "sparse", data / "gt", arguments.binary)


def run_colmap(data, out, arguments):
    kept = out / "figures.json"
    if arguments.reuse_colmap and kept.exists():
        return json.loads(kept.read_text())
    out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, HERE / "run_colmap.py", data / "images", out / "result"]
    figures = measured(command, out / "log.txt")
    lines = (out / "log.txt").read_text().splitlines()
    if figures["status"] != 0 or not lines:
        raise SystemExit(f"{data.name}: COLMAP failed, see {out / 'log.txt'}")
    figures |= json.loads(lines[-1])
    for key in ("wall_s", "cpu_s"):
        figures[key] = sum(stage[key] for stage in figures["stages"].values())
    figures = with_quality(figures, out / "result" / "sparse", data / "gt", arguments.binary)
    kept.write_text(json.dumps(figures, indent=1))
    return figures


def cells(figures, images):
    model = figures["model"] or {"images": 0, "points_3plus": 0, "error_px": None, "wild": None}
    auc = figures["auc_percent"]
    return [
        f"{figures['wall_s']:.1f}",
        f"{figures['cpu_s']:.1f}",
        f"{figures['peak_bytes'] / 1e6:.0f}",
        f"{model['images']}/{images}",
        "-" if auc is None else " / ".join(f"{value:.1f}" for value in auc[:3]),
        str(model["points_3plus"]),
        "-" if model["error_px"] is None else f"{model['error_px']:.2f}",
        "-" if model["wild"] is None else f"{100 * model['wild']:.1f}",
    ]


def ratios(ours, theirs):
    def ratio(value, other):
        return "-" if not other else f"{value / other:.3f}"

    def points(figures):
        return (figures["model"] or {"points_3plus": 0})["points_3plus"]

    costs = [ratio(ours[key], theirs[key]) for key in ("wall_s", "cpu_s", "peak_bytes")]
    density = "-" if not points(theirs) else f"{points(ours) / points(theirs):.2f}"
    return [*costs, "", "", density, "", ""]


def line(values):
    print("| " + " | ".join(values) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--datasets", type=Path, default=Path("../shared/datasets"))
    parser.add_argument("--out", type=Path, default=Path("target/compare"))
    parser.add_argument("--binary", type=Path, default=Path("target/release/multistage"))
    parser.add_argument("--only", default="")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--reuse-colmap", action="store_true")
    arguments = parser.parse_args()
    wanted = [name for name in arguments.only.split(",") if name]
    sets = sorted(path for path in arguments.datasets.iterdir() if (path / "images").is_dir())
    line(HEADER)
    line(["---"] * len(HEADER))
    for data in (data for data in sets if not wanted or data.name in wanted):
        images = sum(path.is_file() for path in (data / "images").rglob("*"))
        ours = run_ours(data, arguments.out / data.name / "multistage", arguments)
        line([data.name, "multistage", *cells(ours, images)])
        theirs = run_colmap(data, arguments.out / data.name / "colmap", arguments)
        line(["", "COLMAP", *cells(theirs, images)])
        line(["", "ratio", *ratios(ours, theirs)])


if __name__ == "__main__":
    main()
