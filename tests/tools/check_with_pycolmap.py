"""Checks the model files of a run with readers that are not ours.

usage: check_with_pycolmap.py OUT_DIR

For every model of OUT_DIR/report.json: pycolmap opens the binary and the text model; the mean distance between keypoints
and points projected by pycolmap's own camera models must equal the report's mean reprojection error; and so must the mean
over bundle.out, computed from that file alone as Bundler's manual defines the projection. Exits with 1 when a figure
differs by more than 0.01 pixels, or when counts differ.
"""
import json
import sys
from pathlib import Path

import numpy as np
import pycolmap

TOLERANCE_PX = 0.01


def colmap_errors(model):
    """The reprojection error of every observation."""
    errors = []
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            projected = image.camera.img_from_cam(image.cam_from_world() * point.xyz)
            errors.append(np.linalg.norm(projected - image.points2D[element.point2D_idx].xy))
    return np.array(errors)


def bundle_errors(path):
    """The reprojection error of every observation in a bundle.out."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    numbers = iter(float(word) for line in lines for word in line.split())
    take = lambda count: np.array([next(numbers) for _ in range(count)])
    num_cameras, num_points = (int(n) for n in take(2))
    cameras = [(take(3), take(9).reshape(3, 3), take(3)) for _ in range(num_cameras)]
    errors = []
    for _ in range(num_points):
        xyz, _color = take(3), take(3)
        for _ in range(int(next(numbers))):
            (f, k1, k2), rotation, translation = cameras[int(next(numbers))]
            _key, x, y = take(3)
            in_camera = rotation @ xyz + translation
            p = -in_camera[:2] / in_camera[2]
            r2 = p @ p
            errors.append(np.linalg.norm(f * (1 + k1 * r2 + k2 * r2 * r2) * p - (x, y)))
    return np.array(errors), num_cameras, num_points


def main():
    out = Path(sys.argv[1])
    models = json.loads((out / "report.json").read_text())["models"]
    failures = []

    def check(what, found, expected, tolerance):
        good = abs(found - expected) <= tolerance
        print(f"  {'ok  ' if good else 'FAIL'} {what}: {found:.6g}, the report says {expected:.6g}")
        if not good:
            failures.append(what)

    for report in models:
        number = str(report["id"])
        print(f"model {number}")
        binary = pycolmap.Reconstruction(str(out / "sparse" / number))
        text = pycolmap.Reconstruction()
        text.read_text(str(out / "sparse" / number))
        for kind, model in (("binary", binary), ("text", text)):
            errors = colmap_errors(model)
            check(f"{kind} images", model.num_reg_images(), report["images"], 0)
            check(f"{kind} points", model.num_points3D(), report["points"], 0)
            check(f"{kind} observations", len(errors), report["observations"], 0)
            check(f"{kind} mean error", errors.mean(), report["mean_reprojection_error_px"], TOLERANCE_PX)
            check(f"{kind} median error", np.median(errors), report["median_reprojection_error_px"], TOLERANCE_PX)
            # COLMAP's own summary is the mean over points of each point's mean, which is another figure.
            print(f"       COLMAP's mean over points: {model.compute_mean_reprojection_error():.6g}")
        errors, num_cameras, num_points = bundle_errors(out / "bundle" / number / "bundle.out")
        names = (out / "bundle" / number / "list.txt").read_text().splitlines()
        check("bundle.out images", num_cameras, report["images"], 0)
        check("list.txt images", len(names), report["images"], 0)
        check("bundle.out points", num_points, report["points"], 0)
        check("bundle.out mean error", errors.mean(), report["mean_reprojection_error_px"], TOLERANCE_PX)
    if not models:
        failures.append("there is no model to check")
    if failures:
        sys.exit("failed: " + ", ".join(failures))


main()
