#!/usr/bin/env python3
"""Compares the project's SIFT with OpenCV's (and, with --colmap, pycolmap's) on warped photographs.

    pip install opencv-python-headless numpy [pycolmap]
    cargo build --release --example sift_extract
    python benches/sift/compare_opencv.py PHOTO... [--binary target/release/examples/sift_extract] [--features 4000]

Every photograph is reduced to at most --side pixels, then turned, scaled, tilted, brightened, blurred and made noisy by a
known homography. All extractors have the same threshold of contrast (0.02 / 3) and give the same number of keypoints of
a picture: as many as ours finds, at most --features (0: no limit). Of more, OpenCV gives those of the strongest response
(its own choice) or, with --by-scale, of the largest scale; ours and COLMAP's are those of the largest scale. OpenCV's
descriptors are turned into RootSIFT, too. Printed per warp, summed over the photographs:

    repeatability   keypoints of the first picture with one of the second within --tolerance pixels and a scale ratio
                    below 1.3, over the smaller number of keypoints in the common area, in per cent
    features        keypoints of the second picture
    correct         mutual nearest neighbours that pass the ratio test (0.8) and agree with the homography (3 px)
    wrong           those that pass and do not agree
    error           median distance of the correct ones, pixels
"""

import argparse
import pathlib
import subprocess
import tempfile
import time

import cv2
import numpy as np


def ours(image, args, _):
    with tempfile.TemporaryDirectory() as folder:
        source, out = pathlib.Path(folder, "image.png"), pathlib.Path(folder, "features")
        cv2.imwrite(str(source), image)
        command = [args.binary, source, out, "--max", str(args.features or 10**6)]
        seconds = float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[0])
        data = out.read_bytes()
    count = int(np.frombuffer(data, "<u4", 1)[0])
    keypoints = np.frombuffer(data, "<f4", 4 * count, 4).reshape(count, 4)
    descriptors = np.frombuffer(data, np.uint8, 128 * count, 4 + 16 * count).reshape(count, 128)
    return keypoints.astype(np.float32), descriptors.astype(np.float32), seconds


def opencv(image, args, count):
    sift = cv2.SIFT_create(nfeatures=0 if args.by_scale else count, contrastThreshold=args.contrast, enable_precise_upscale=True)
    start = time.process_time()
    found, descriptors = sift.detectAndCompute(image, None)
    seconds = time.process_time() - start
    # OpenCV counts from the centre of the first pixel and gives diameters.
    keypoints = np.array([(*k.pt, k.size / 2, np.radians(k.angle)) for k in found], np.float32)
    keypoints[:, :2] += 0.5
    order = np.argsort(-keypoints[:, 2], kind="stable") if args.by_scale else np.arange(len(keypoints))
    order = order[:count]
    return keypoints[order], rooted(descriptors[order]), seconds


def colmap(image, args, count):
    import pycolmap

    options = pycolmap.SiftExtractionOptions()
    options.max_num_features = count
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.sift = options
    start = time.process_time()
    keypoints, descriptors = pycolmap.Sift(extraction, device=pycolmap.Device.cpu).extract(image)
    seconds = time.process_time() - start
    order = np.argsort(-keypoints[:, 2], kind="stable")[:count]
    return np.asarray(keypoints, np.float32)[order], np.asarray(descriptors, np.float32)[order], seconds


def rooted(descriptors):
    return 512 * np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))


def warps(height, width):
    """Each warp: name, homography (pixels, first centre at 0.5), size of the result, change of the grey values."""
    rng = np.random.default_rng(1)

    def similarity(degrees, scale):
        turn = np.radians(degrees)
        linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        corners = np.array([[0, 0], [width, 0], [0, height], [width, height]]) @ linear.T
        low, high = corners.min(0), corners.max(0)
        homography = np.eye(3)
        homography[:2, :2], homography[:2, 2] = linear, -low
        return homography, tuple(int(v) for v in np.ceil(high - low))

    same = (np.eye(3), (width, height))
    tilt = cv2.getPerspectiveTransform(
        np.float32([[0, 0], [width, 0], [width, height], [0, height]]),
        np.float32([[0.15 * width, 0.1 * height], [0.9 * width, 0], [width, height], [0, 0.85 * height]]),
    )
    plain = lambda image: image
    noise = lambda image: np.clip(image + rng.normal(0, 8, image.shape), 0, 255)
    yield "rotate 30", *similarity(30, 1), plain
    yield "rotate 90", *similarity(90, 1), plain
    yield "rotate 180", *similarity(180, 1), plain
    yield "scale 0.8", *similarity(0, 0.8), plain
    yield "scale 0.5", *similarity(0, 0.5), plain
    yield "perspective", tilt, (width, height), plain
    yield "brightness", *same, lambda image: np.clip(0.6 * image + 50, 0, 255)
    yield "blur 1.5", *same, lambda image: cv2.GaussianBlur(image, (0, 0), 1.5)
    yield "noise 8", *same, noise
    yield "all", *similarity(17, 0.7), lambda image: noise(np.clip(0.8 * image + 20, 0, 255))


def warp(image, homography, size, change):
    # OpenCV's pixels count from the centre of the first; shrinking needs a blur first.
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    scale = np.sqrt(abs(np.linalg.det(homography[:2, :2])))
    image = image.astype(np.float32)
    if scale < 0.95:
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / scale**2 - 1))
    matrix = np.linalg.inv(half) @ homography @ half
    image = cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(np.rint(change(np.clip(image, 0, 255))), 0, 255).astype(np.uint8)


def extract_all(image, args, extractors):
    """The features of every extractor, ours first: it sets the number."""
    results, count = {}, 0
    for name, extract in extractors.items():
        results[name] = extract(image, args, count)
        count = count or len(results[name][0])
    return results


def transfer(homography, points):
    out = np.c_[points, np.ones(len(points))] @ homography.T
    return out[:, :2] / out[:, 2:]


def local_scale(homography, points):
    step = 0.5
    dx = transfer(homography, points + [step, 0]) - transfer(homography, points - [step, 0])
    dy = transfer(homography, points + [0, step]) - transfer(homography, points - [0, step])
    return np.sqrt(np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]))


def repeatability(a, b, homography, sizes, tolerance):
    def inside(points, size):
        margin = 8
        return ((points > margin) & (points < np.array(size) - margin)).all(1)

    place, scale = transfer(homography, a[:, :2]), a[:, 2] * local_scale(homography, a[:, :2])
    keep = inside(place, sizes[1])
    back = inside(transfer(np.linalg.inv(homography), b[:, :2]), sizes[0])
    place, scale, b = place[keep], scale[keep], b[back]
    # Keypoints with two orientations count once.
    place, index = np.unique(np.round(place, 3), axis=0, return_index=True)
    scale = scale[index]
    _, index = np.unique(b[:, :2], axis=0, return_index=True)
    b = b[index]
    found = 0
    for first in range(0, len(place), 1000):
        rows = slice(first, first + 1000)
        off = ((place[rows, None] - b[None, :, :2]) ** 2).sum(2)
        ratio = np.abs(np.log(scale[rows, None] / b[None, :, 2]))
        found += ((off < tolerance**2) & (ratio < np.log(1.3))).any(1).sum()
    return found, min(len(place), len(b))


def matching(a, b, homography):
    (keypoints_a, descriptors_a), (keypoints_b, descriptors_b) = a, b
    dots = descriptors_a @ descriptors_b.T
    squares = (descriptors_a**2).sum(1)[:, None] + (descriptors_b**2).sum(1)[None] - 2 * dots
    nearest = np.argpartition(squares, 1, axis=1)[:, :2]
    rows = np.arange(len(squares))
    pair = np.sort(squares[rows[:, None], nearest], axis=1)
    best = squares.argmin(1)
    good = (pair[:, 0] < 0.64 * pair[:, 1]) & (squares.argmin(0)[best] == rows)
    off = np.linalg.norm(transfer(homography, keypoints_a[good, :2]) - keypoints_b[best[good], :2], axis=1)
    return off[off < 3], (off >= 3).sum()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+")
    parser.add_argument("--binary", default="target/release/examples/sift_extract")
    parser.add_argument("--features", type=int, default=0)
    parser.add_argument("--side", type=int, default=1200)
    parser.add_argument("--tolerance", type=float, default=1.5)
    parser.add_argument("--contrast", type=float, default=0.006, help="contrast threshold of OpenCV; ours is 0.006 / 3")
    parser.add_argument("--by-scale", action="store_true", help="OpenCV's features of the largest scale, too")
    parser.add_argument("--colmap", action="store_true")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    extractors = {"ours": ours, "opencv": opencv} | ({"colmap": colmap} if args.colmap else {})
    totals, seconds = {}, dict.fromkeys(extractors, 0.0)
    for photo in args.photos:
        image = cv2.imread(photo, cv2.IMREAD_GRAYSCALE)
        if max(image.shape) > args.side:
            image = cv2.resize(image, None, fx=args.side / max(image.shape), fy=args.side / max(image.shape),
                               interpolation=cv2.INTER_AREA)
        sizes = image.shape[::-1]
        base = extract_all(image, args, extractors)
        for warp_name, homography, size, change in warps(*image.shape):
            picture = warp(image, homography, size, change)
            for name, other in extract_all(picture, args, extractors).items():
                seconds[name] += other[2]
                found, possible = repeatability(base[name][0], other[0], homography, (sizes, size), args.tolerance)
                off, wrong = matching(base[name][:2], other[:2], homography)
                total = totals.setdefault((warp_name, name), [0, 0, 0, 0, [], 0])
                for i, value in enumerate((found, possible, len(off), wrong)):
                    total[i] += value
                total[4].append(off)
                total[5] += len(other[0])
    names = list(extractors)
    print(f"{'':12}" + "".join(f"| {name:^42}" for name in names))
    print(f"{'warp':12}" + "".join(f"| {'features':>8}{'repeat %':>9}{'correct':>9}{'wrong':>7}{'error px':>9}" for _ in names))

    def cells(rows):
        found, possible, correct, wrong = (sum(row[i] for row in rows) for i in range(4))
        error = np.median(np.concatenate([off for row in rows for off in row[4]]))
        features = sum(row[5] for row in rows)
        return f"| {features:8}{100 * found / max(possible, 1):9.1f}{correct:9}{wrong:7}{error:9.3f}"

    for warp_name in dict.fromkeys(key[0] for key in totals):
        print(f"{warp_name:12}" + "".join(cells([totals[warp_name, name]]) for name in names))
    print(f"{'all warps':12}" + "".join(cells([totals[key] for key in totals if key[1] == name]) for name in names))
    print("CPU s       " + "".join(f"| {seconds[name]:42.2f}" for name in names))


if __name__ == "__main__":
    main()
