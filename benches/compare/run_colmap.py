#!/usr/bin/env python3
"""Runs COLMAP (pycolmap) on a folder of photographs with its default options on the CPU: features, exhaustive matching,
incremental mapper. Writes OUT/sparse/<k>/ and prints one line of JSON with wall and CPU seconds of each stage.

usage: benches/compare/run_colmap.py IMAGES OUT
"""
import json
import resource
import shutil
import sys
import time
from pathlib import Path

import pycolmap


def cpu_s():
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def main():
    images, out = Path(sys.argv[1]), Path(sys.argv[2])
    shutil.rmtree(out, ignore_errors=True)
    sparse = out / "sparse"
    sparse.mkdir(parents=True)
    database = out / "database.db"
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = 2
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.use_gpu = matching.use_gpu = False
    cpu = pycolmap.Device.cpu
    stages = {}

    def timed(name, call):
        wall, before = time.monotonic(), cpu_s()
        call()
        stages[name] = {"wall_s": time.monotonic() - wall, "cpu_s": cpu_s() - before}

    timed("features", lambda: pycolmap.extract_features(database, images, extraction_options=extraction, device=cpu))
    timed("matching", lambda: pycolmap.match_exhaustive(database, matching_options=matching, device=cpu))
    timed("mapping", lambda: pycolmap.incremental_mapping(database, images, sparse))
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps({"version": pycolmap.__version__, "stages": stages, "peak_bytes": peak_bytes}))


if __name__ == "__main__":
    main()
