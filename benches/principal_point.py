#!/usr/bin/env python3
"""Is the principal point of a model real? Estimates it from disjoint parts of the photographs, each adjusted on its own.

    pip install pycolmap numpy
    multistage reconstruct IMAGES --out OUT
    python benches/principal_point.py OUT/sparse/0 [--parts 4]

Where the parts agree with each other and not with the middle of the picture, the camera's axis really meets the sensor there; a
reference made by a program that holds the principal point in the middle then turns every camera by offset / focal. The
adjustment is COLMAP's (Ceres), not this project's.
"""
import argparse

import pycolmap


def adjusted(folder, names):
    """The first camera after an adjustment of the images of these names alone, everything free."""
    model = pycolmap.Reconstruction(str(folder))
    for image in list(model.reg_image_ids()):
        if model.images[image].name not in names:
            model.deregister_frame(model.images[image].frame_id)
    for point in [key for key, point in model.points3D.items() if point.track.length() < 2]:
        model.delete_point3D(point)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = True
    options.ceres.solver_options.max_num_iterations = 100
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)
    return next(iter(model.cameras.values()))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--parts", type=int, default=4)
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    model = pycolmap.Reconstruction(arguments.model)
    if len(model.cameras) != 1:
        parser.error("the images must share one camera")
    names = sorted(model.images[image].name for image in model.reg_image_ids())
    print("| photographs | focal px | principal point, off the middle, px |\n| --- | --- | --- |")
    size = len(names) / arguments.parts
    for part in range(arguments.parts):
        chosen = set(names[round(part * size) : round((part + 1) * size)])
        camera = adjusted(arguments.model, chosen)
        dx, dy = camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2
        print(f"| {len(chosen)} | {camera.mean_focal_length():.1f} | {dx:+.1f}, {dy:+.1f} |", flush=True)


if __name__ == "__main__":
    main()
