#!/usr/bin/env python3
"""Runs `multistage reconstruct` with default options on every data set of a folder and prints a table.

usage: benches/datasets.py [--datasets ../shared/datasets] [--tools ../shared/tools] [--out target/datasets]
                           [--only NAME,NAME] [--binary target/release/multistage] [-- further arguments]

A data set is a folder with `images/`, and `gt/poses.txt` where reference poses are known; those are scored by the
tools' eval_poses.py, independently of this program. Needs python3 with numpy.
"""
import argparse
import json
import subprocess
import sys
from pathlib import Path

def score(tools, model, reference):
    """AUC at 1, 3, 5 degrees as a string, or a dash."""
    if not (reference / "poses.txt").exists():
        return "-"
    command = [sys.executable, str(tools / "eval_poses.py"), str(model), str(reference), "--json"]
    answer = subprocess.run(command, capture_output=True, text=True)
    if answer.returncode != 0:
        return "eval failed: " + answer.stderr.strip().splitlines()[-1]
    figures = json.loads(answer.stdout)
    return " / ".join(f"{figures['auc' + key]:.1f}" for key in ("1", "3", "5"))

def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--datasets", type=Path, default=Path("../shared/datasets"))
    parser.add_argument("--tools", type=Path, default=Path("../shared/tools"))
    parser.add_argument("--out", type=Path, default=Path("target/datasets"))
    parser.add_argument("--binary", type=Path, default=Path("target/release/multistage"))
    parser.add_argument("--only", default="")
    parser.add_argument("rest", nargs="*")
    arguments = parser.parse_args()
    wanted = [name for name in arguments.only.split(",") if name]
    print("| set | registered | models | points / 3+ | error px | AUC@1 / 3 / 5 | wall s | CPU s | peak MB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for folder in sorted(path for path in arguments.datasets.iterdir() if (path / "images").is_dir()):
        if wanted and folder.name not in wanted:
            continue
        out = arguments.out / folder.name
        command = [str(arguments.binary), "reconstruct", str(folder / "images"), "--out", str(out), *arguments.rest]
        run = subprocess.run(command, capture_output=True, text=True)
        if run.returncode not in (0, 3):
            print(f"| {folder.name} | failed ({run.returncode}): {run.stderr.strip().splitlines()[-1:]} |")
            continue
        report = json.loads((out / "report.json").read_text())
        models = report["models"]
        largest = models[0] if models else {"images": 0, "points": 0, "points_3plus": 0, "mean_reprojection_error_px": None}
        error = largest["mean_reprojection_error_px"]
        row = [
            folder.name,
            f"{largest['images']}/{report['input']['images']}",
            "+".join(str(model["images"]) for model in models) or "0",
            f"{largest['points']} / {largest['points_3plus']}",
            "-" if error is None else f"{error:.2f}",
            score(arguments.tools, out / "bundle" / "0" / "bundle.out", folder / "gt") if models else "-",
            f"{report['wall_s']:.1f}",
            f"{report['cpu_s']:.1f}",
            f"{(report['peak_rss_bytes'] or 0) / 1e6:.0f}",
        ]
        print("| " + " | ".join(row) + " |", flush=True)

if __name__ == "__main__":
    main()
