"""What a COLMAP model folder is worth, read by pycolmap: images, points, errors, and the share of wild points."""

import numpy as np
import pycolmap

# A point is wild when its widest ray angle is below this, or when it lies further from the points' median than this many
# times their median distance from there.
MIN_RAY_ANGLE_DEG = 2.0
MAX_MEDIAN_RADII = 10.0


def widest_ray_angle_deg(point, centers):
    """The largest angle between two rays from the cameras' centres to the point."""
    rays = centers - point
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)))


def largest_model(sparse):
    """The folder of the model with the most images below `sparse`, or none."""
    folders = [path for path in sparse.iterdir() if (path / "images.bin").exists()] if sparse.is_dir() else []
    return max(folders, key=lambda path: pycolmap.Reconstruction(path).num_reg_images(), default=None)


def measure(folder):
    """Figures of the model in `folder`."""
    model = pycolmap.Reconstruction(folder)
    center = {number: model.images[number].projection_center() for number in model.reg_image_ids()}
    points = list(model.points3D.values())
    if not points:
        return {"images": model.num_reg_images(), "points": 0, "points_3plus": 0, "error_px": None, "wild": None}
    places = np.array([point.xyz for point in points])
    distances = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    far = distances > MAX_MEDIAN_RADII * np.median(distances)
    seen_from = ({element.image_id for element in point.track.elements} for point in points)
    narrow = np.array(
        [
            widest_ray_angle_deg(place, np.array([center[number] for number in images])) < MIN_RAY_ANGLE_DEG
            for place, images in zip(places, seen_from)
        ]
    )
    model.update_point_3d_errors()
    return {
        "images": model.num_reg_images(),
        "points": len(points),
        "points_3plus": sum(point.track.length() >= 3 for point in points),
        "error_px": model.compute_mean_reprojection_error(),
        "wild": float(np.mean(far | narrow)),
    }
