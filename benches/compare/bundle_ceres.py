"""Adjusts COLMAP models by COLMAP's own bundle adjustment (Ceres), for comparison with `benches/bundle.rs`.

    pip install pycolmap
    cargo bench --bench bundle -- --write /tmp/starts
    python benches/compare/bundle_ceres.py --threads 1 /tmp/starts/*

The same problem: no robust loss, focal length and distortion free, principal point held, the same tolerances.
"""

import argparse
import time

import pycolmap


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("models", nargs="+")
    arguments = parser.parse_args()
    print(f"{'sightings':>9} {'cost':>11} {'steps':>6} {'taken':>6} {'CPU s':>9} {'ms a step':>11}")
    for folder in arguments.models:
        model = pycolmap.Reconstruction(folder)
        options = pycolmap.BundleAdjustmentOptions()
        options.print_summary = False
        options.refine_focal_length = True
        options.refine_extra_params = True
        options.refine_principal_point = False
        ceres = options.ceres
        solver = ceres.solver_options
        solver.function_tolerance = 1e-6
        solver.gradient_tolerance = 1e-4
        solver.parameter_tolerance = 1e-8
        solver.max_num_iterations = 50
        solver.num_threads = arguments.threads
        config = pycolmap.BundleAdjustmentConfig()
        for image in model.reg_image_ids():
            config.add_image(image)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
        before = time.process_time()
        summary = adjuster.solve()
        spent_s = time.process_time() - before
        summary = getattr(summary, "ceres_summary", summary)
        steps = summary.num_successful_steps + summary.num_unsuccessful_steps - 1
        print(
            f"{summary.num_residuals // 2:>9} {summary.final_cost:>11.1f} {steps:>6} "
            f"{summary.num_successful_steps - 1:>6} {spent_s:>9.3f} {1e3 * spent_s / max(steps, 1):>11.2f}  "
            f"{summary.termination_type}  {folder}"
        )


if __name__ == "__main__":
    main()
