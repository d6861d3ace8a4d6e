"""How long it takes to grade a video: our functions beside what others use for the same numbers, same videos, same run.

    python -m benchmarks.metrics [--frames 121] [--device cpu]        # scikit-image, lpips, OpenCV, fastdtw
    python -m benchmarks.metrics --device cuda                        # torchmetrics and lpips on the same GPU

The videos are made here, 320x240: an arm of five links before a textured wall, and the same arm late, off by some degrees,
blurred and grainy, with its masks and 16 points along the links. On a CPU the peers are scikit-image for PSNR and SSIM, the
package lpips at the best of several batch sizes, OpenCV's morphology with NumPy's counts, and fastdtw; the whole suite is
all of these on one video, with our PCK, errors and coverage, and without region LPIPS, which nobody has.
On a GPU it is PSNR, SSIM (uniform 7x7) and LPIPS of one uint8 video, from the host or on the GPU already, to numbers on the
host: torchmetrics and lpips at the best of several batch sizes, and one frame at a time as most projects do. LPIPS is
computed in float32 by us; by PyTorch in float32, and in TF32, which is its default, beside it. What is not installed is said
and done in plain PyTorch. Before a figure is told, all results are compared; then contenders take turns, and medians are
told: by the clock, and of the processors' time, which a busy machine disturbs less.
"""

import functools
import importlib
import os
import tempfile
import time
import types
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import jax
import numpy as np
import tyro

from benchmarks.common import format_versions, is_installed
from xew.metrics import METRICS, boundary_f1, lpips, mask_iou, ndtw, psnr, ssim
from xew.metrics.networks.alexnet import read_alexnet

HEIGHT, WIDTH, LINKS, POINTS = 240, 320, 5, 16
BATCHES = (1, 8, 32, 128)
"""Frames of a batch that peers are tried with."""
PACKAGES = (
    "jax",
    "numpy",
    "scikit-image",
    "torch",
    "torchvision",
    "lpips",
    "torchmetrics",
    "opencv-python-headless",
    "fastdtw",
)
Run = Callable[[], Any]


@dataclass(frozen=True)
class Args:
    device: Annotated[str, tyro.conf.arg(metavar="cpu|cuda")] = "cpu"
    frames: int = 121
    rounds: int = 5
    """Turns of each contender."""


@dataclass(frozen=True)
class Pair:
    """A predicted and a true video with all that the metrics compare."""

    prediction: np.ndarray
    target: np.ndarray
    """[t h w 3] uint8."""
    predicted_mask: np.ndarray
    mask: np.ndarray
    """[t h w] bool."""
    predicted_points: np.ndarray
    points: np.ndarray
    """[t k 2] float32 pixels."""


def make_pair(frames: int) -> Pair:
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(60, 200, (30, 40, 3), dtype=np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    true = [draw_arm(wall, joints(t)) for t in range(frames)]
    wrong = [draw_arm(wall, joints(max(t - 3, 0)) + 0.05) for t in range(frames)]
    grain = rng.normal(0, 3, (frames, HEIGHT, WIDTH, 3))
    blurred = np.stack([cv2.GaussianBlur(frame, (0, 0), 0.8) for frame, _, _ in wrong])
    return Pair(
        prediction=np.clip(blurred + grain, 0, 255).astype(np.uint8),
        target=np.stack([frame for frame, _, _ in true]),
        predicted_mask=np.stack([mask for _, mask, _ in wrong]),
        mask=np.stack([mask for _, mask, _ in true]),
        predicted_points=np.stack([points for _, _, points in wrong]),
        points=np.stack([points for _, _, points in true]),
    )


def joints(t: int) -> np.ndarray:
    return np.array([-1.2, 0.5, 0.6, -0.7, 0.4]) + 0.5 * np.sin(0.05 * t + np.arange(LINKS))


def draw_arm(wall: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The frame [h w 3], its mask [h w], and points [k 2] along the links."""
    turns = np.cumsum(angles)
    corners = np.cumsum([(160.0, 230.0), *(42 * np.stack([np.cos(turns), np.sin(turns)], axis=1))], axis=0)
    frame, mask = wall.copy(), np.zeros((HEIGHT, WIDTH), np.uint8)
    for i, (start, end) in enumerate(zip(corners[:-1].astype(int), corners[1:].astype(int), strict=True)):
        for image, color in ((frame, (230 - 20 * i, 120, 40 + 30 * i)), (mask, (1,))):
            cv2.line(image, start.tolist(), end.tolist(), color, 22 - 3 * i)
    share = np.linspace(0, LINKS, POINTS)
    points = np.stack([np.interp(share, np.arange(LINKS + 1), corners[:, axis]) for axis in (0, 1)], axis=1)
    return frame, mask.astype(bool), points.astype(np.float32)


# ---- peers ----


def scikit_image(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """PSNR and SSIM [t]."""
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    frames = list(zip(pair.target, pair.prediction, strict=True))
    similar = [structural_similarity(t, p, channel_axis=-1, data_range=255) for t, p in frames]
    return np.array([peak_signal_noise_ratio(t, p) for t, p in frames]), np.array(similar)


def opencv(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """IoU and boundary F1 [t]."""
    square = np.ones((3, 3), np.uint8)
    disc = np.uint8([[0, 0, 1, 0, 0], [0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 0, 1, 0, 0]])
    iou, f1 = [], []
    for p, t in zip(pair.predicted_mask.view(np.uint8), pair.mask.view(np.uint8), strict=True):
        edge_p, edge_t = p - cv2.erode(p, square), t - cv2.erode(t, square)
        precision = np.count_nonzero(edge_p & cv2.dilate(edge_t, disc)) / max(np.count_nonzero(edge_p), 1)
        recall = np.count_nonzero(edge_t & cv2.dilate(edge_p, disc)) / max(np.count_nonzero(edge_t), 1)
        f1.append(2 * precision * recall / max(precision + recall, 1e-9))
        iou.append(np.count_nonzero(p & t) / max(np.count_nonzero(p | t), 1))
    return np.array(iou), np.array(f1)


def time_warping(pair: Pair, warp: Callable[..., tuple[float, Any]]) -> float:
    """nDTW by a function of the package fastdtw."""
    diagonal = np.linalg.norm(np.ptp(pair.points, axis=1), axis=-1).mean()
    paths = zip(pair.predicted_points.swapaxes(0, 1), pair.points.swapaxes(0, 1), strict=True)
    return float(np.mean([warp(p, t, dist=2)[0] for p, t in paths]) / (2 * len(pair.points) * diagonal))


def torch_lpips(device: str) -> Callable[[Any, Any], Any]:
    """Distance of frames [n 3 h w] float32 in [-1, 1]: the package lpips, else the same network in plain PyTorch."""
    import torch

    weights = read_alexnet()
    if not is_installed("lpips"):
        print("lpips is not installed; the same network is built in plain PyTorch")
        return plain_lpips(torch, weights, device)
    network = lpips_network(torch)
    for i, layer in enumerate(module for module in network.net.modules() if isinstance(module, torch.nn.Conv2d)):
        layer.weight.data.copy_(torch.from_numpy(weights[f"conv{i}_kernel"].transpose(3, 2, 0, 1).copy()))
        layer.bias.data.copy_(torch.from_numpy(weights[f"conv{i}_bias"].copy()))
    return network.to(device)


def lpips_network(torch: Any) -> Any:
    """`lpips` takes the trunk's layers from torchvision, whose wheels ask for CUDA; a stand-in serves where it fails."""
    import sys

    nn = torch.nn
    layers = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU()]
    layers += [nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(), nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU()]
    layers += [nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU()]
    trunk = types.SimpleNamespace(features=nn.Sequential(*layers))
    before = sys.modules.get("torchvision")
    sys.modules["torchvision"] = types.ModuleType("torchvision")
    sys.modules["torchvision"].models = types.SimpleNamespace(alexnet=lambda **_: trunk)  # type: ignore[attr-defined]
    try:
        package = importlib.import_module("lpips")
        return package.LPIPS(net="alex", version="0.1", pnet_rand=True, verbose=False).eval()
    finally:
        sys.modules.pop("torchvision") if before is None else sys.modules.update(torchvision=before)


def plain_lpips(torch: Any, weights: Any, device: str) -> Callable[[Any, Any], Any]:
    functional = torch.nn.functional
    move = lambda array: torch.from_numpy(np.ascontiguousarray(array)).to(device)  # noqa: E731
    kernels = [move(weights[f"conv{i}_kernel"].transpose(3, 2, 0, 1)) for i in range(5)]
    biases = [move(weights[f"conv{i}_bias"]) for i in range(5)]
    heads = [move(weights[f"head{i}"])[:, None, None] for i in range(5)]
    shift, scale = (move(np.float32(c)[:, None, None]) for c in ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]))
    shape = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))

    def features(x: Any) -> list[Any]:
        found, x = [], (x - shift) / scale
        for i, (stride, padding) in enumerate(shape):
            x = functional.max_pool2d(x, 3, 2) if i in (1, 2) else x
            x = functional.relu(functional.conv2d(x, kernels[i], biases[i], stride, padding))
            found.append(x / (torch.sqrt(torch.sum(x * x, 1, keepdim=True)) + 1e-10))
        return found

    def distance(a: Any, b: Any) -> Any:
        pairs = zip(features(a), features(b), heads, strict=True)
        return sum(((x - y) ** 2 * head).sum(1).mean((1, 2)) for x, y, head in pairs)

    return distance


def torch_psnr(p: Any, t: Any) -> Any:
    """Of [n 3 h w] in [0, 1]; as torchmetrics does it, one value a frame."""
    return -10 * ((p - t) ** 2).mean((1, 2, 3)).log10()


def torch_ssim() -> Callable[[Any, Any], Any]:
    """Uniform 7x7 SSIM of [n 3 h w] in [0, 1] by torchmetrics, else in plain PyTorch."""
    import torch

    if is_installed("torchmetrics"):
        function = importlib.import_module("torchmetrics.functional.image").structural_similarity_index_measure
        options = {"gaussian_kernel": False, "kernel_size": 7, "data_range": 1.0, "reduction": "none"}
        return lambda p, t: function(p, t, **options)
    print("torchmetrics is not installed; SSIM is done in plain PyTorch by average pooling, which is less work")
    pool = functools.partial(torch.nn.functional.avg_pool2d, kernel_size=7, stride=1)

    def similarity(p: Any, t: Any) -> Any:
        mean_p, mean_t = pool(p), pool(t)
        var_p, var_t, shared = pool(p * p) - mean_p**2, pool(t * t) - mean_t**2, pool(p * t) - mean_p * mean_t
        unbiased = 49 / 48
        top = (2 * mean_p * mean_t + 1e-4) * (2 * unbiased * shared + 9e-4)
        return (top / ((mean_p**2 + mean_t**2 + 1e-4) * (unbiased * (var_p + var_t) + 9e-4))).mean((1, 2, 3))

    return similarity


def by_batch(
    videos: tuple[Any, Any], batch: int, device: str, *functions: tuple[Callable[[Any, Any], Any], bool]
) -> list[np.ndarray]:
    """[t] of each function of (prediction, target), which takes frames in [-1, 1] if its flag says so, else in [0, 1].

    The videos [t h w 3] uint8 are arrays, or tensors on a device.
    """
    import torch

    found: list[list[Any]] = [[] for _ in functions]
    with torch.no_grad():
        for i in range(0, len(videos[0]), batch):
            frames = [torch.as_tensor(video[i : i + batch]).to(device) for video in videos]
            unit = [v.permute(0, 3, 1, 2).float() / 255 for v in frames]
            for values, (function, signed) in zip(found, functions, strict=True):
                values.append(function(*(2 * v - 1 if signed else v for v in unit)).reshape(-1))
        return [torch.cat(values).cpu().numpy() for values in found]


# ---- races ----


def race(contenders: dict[str, Run], rounds: int) -> dict[str, tuple[float, float]]:
    """Median seconds of each, by the clock and of processor time. They take turns, so that what disturbs one disturbs all."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in contenders}
    for run in contenders.values():
        jax.block_until_ready(run())
    for _ in range(rounds):
        for name, run in contenders.items():
            start = time.perf_counter(), time.process_time()
            jax.block_until_ready(run())
            times[name].append((time.perf_counter() - start[0], time.process_time() - start[1]))
    return {name: tuple(np.median(pairs, axis=0).tolist()) for name, pairs in times.items()}


def tell(title: str, seconds: dict[str, tuple[float, float]]) -> None:
    """The first is ours; a factor is how many times as long another takes."""
    first = next(iter(seconds.values()))
    print(f"\n{title:46s}{'clock [ms]':>12s}{'factor':>8s}{'processors [ms]':>18s}{'factor':>8s}")
    for name, (clock, cpu) in seconds.items():
        print(
            f"  {name:44s}{1e3 * clock:12.1f}{clock / first[0]:8.2f}{1e3 * cpu:18.1f}{cpu / max(first[1], 1e-9):8.2f}",
            flush=True,
        )


def best(name: str, runs: dict[int, Run]) -> tuple[str, Run]:
    """The fastest of several batch sizes, each tried twice after a first call."""
    seconds = race({str(batch): run for batch, run in runs.items()}, 2)
    batch = min(seconds, key=lambda key: seconds[key])
    tried = ", ".join(f"{key}: {1e3 * clock:.0f} ms" for key, (clock, _) in seconds.items())
    print(f"{name} by frames of a batch: {tried}")
    return f"{name}, batch {batch}", runs[int(batch)]


def compare(name: str, ours: Any, theirs: Any, tolerance: float) -> None:
    error = float(np.abs(np.asarray(ours, np.float64) - theirs).max())
    assert error <= tolerance, f"{name} differs by {error:.1e}, more than {tolerance:.0e}; nothing is timed"
    print(f"agreement, {name}: {error:.1e}")


def whole_suite(pair: Pair) -> list[Any]:
    """One call of each metric, as a user makes them."""
    valid = np.ones(pair.points.shape[:2], bool)
    inputs = {
        "video": (pair.prediction, pair.target),
        "mask": (pair.predicted_mask, pair.mask),
        "track": (pair.predicted_points, pair.points, valid),
    }
    return [metric.function(*inputs[metric.inputs]) for metric in METRICS.values() if metric.inputs in inputs]


def mask_scores(prediction: Any, target: Any) -> tuple[Any, Any]:
    return mask_iou(prediction, target), boundary_f1(prediction, target)


def on_cpu(pair: Pair, rounds: int) -> None:
    import fastdtw

    network, video = torch_lpips("cpu"), (pair.prediction, pair.target)
    valid = np.ones(pair.points.shape[:2], bool)
    p, t = jax.device_put(video)
    tracks = (pair.predicted_points, pair.points, valid)
    theirs_psnr, theirs_ssim = scikit_image(pair)
    theirs_lpips = by_batch(video, 8, "cpu", (network, True))[0]
    compare("PSNR and scikit-image [dB]", psnr(p, t), theirs_psnr, 1e-4)
    compare("SSIM and scikit-image", ssim(p, t), theirs_ssim, 1e-6)
    compare("LPIPS and lpips", lpips(p, t), theirs_lpips, 1e-6)
    compare("masks and OpenCV", mask_scores(pair.predicted_mask, pair.mask), opencv(pair), 1e-6)
    compare("nDTW and fastdtw's exact table", ndtw(*tracks), time_warping(pair, fastdtw.dtw), 1e-5)
    name, torch_best = best("lpips", {batch: lambda b=batch: by_batch(video, b, "cpu", (network, True)) for batch in BATCHES})
    turn = functools.partial(race, rounds=rounds)
    tell("PSNR and SSIM", turn({"ours": lambda: (psnr(p, t), ssim(p, t)), "scikit-image": lambda: scikit_image(pair)}))
    tell("LPIPS", turn({"ours": lambda: lpips(p, t), name: torch_best}))
    masks = jax.device_put((pair.predicted_mask, pair.mask))
    tell("IoU and boundary F1", turn({"ours": lambda: mask_scores(*masks), "OpenCV": lambda: opencv(pair)}))
    warp = {"ours": lambda: ndtw(*tracks), "fastdtw (approximate)": lambda: time_warping(pair, fastdtw.fastdtw)}
    tell(f"nDTW of {POINTS} points", turn(warp))
    peers = lambda: (scikit_image(pair), torch_best(), opencv(pair), time_warping(pair, fastdtw.fastdtw))  # noqa: E731
    tell("whole suite", turn({"ours": lambda: whole_suite(pair), "sum of the peers": peers}))


def on_gpu(pair: Pair, rounds: int) -> None:
    import torch

    torch.backends.cudnn.benchmark = True
    video = (pair.prediction, pair.target)
    functions = ((torch_psnr, False), (torch_ssim(), False), (torch_lpips("cuda"), True))

    def ours(videos: Any) -> list[np.ndarray]:
        p, t = jax.device_put(videos)
        return jax.device_get([psnr(p, t), ssim(p, t), lpips(p, t)])

    def theirs(videos: Any, batch: int, tf32: bool) -> list[np.ndarray]:
        torch.backends.cudnn.allow_tf32 = tf32
        return by_batch(videos, batch, "cuda", *functions)

    start = time.perf_counter()
    found = ours(video)
    print(f"first call, compiling or reading compiled programs: {time.perf_counter() - start:.1f} s")
    expected = theirs(video, 32, tf32=False)
    compare("PSNR and PyTorch [dB]", found[0], expected[0], 1e-3)
    # torchmetrics has other borders and the population's covariance: near, but another number.
    compare("SSIM and PyTorch", found[1], expected[1], 5e-3 if is_installed("torchmetrics") else 1e-4)
    compare("LPIPS and PyTorch in float32", found[2], expected[2], 2e-6)
    there = tuple(torch.as_tensor(v).cuda() for v in video)
    for title, mine, others in (("host to host", video, video), ("of video on the GPU", jax.device_put(video), there)):
        contenders: dict[str, Run] = {"ours, float32": functools.partial(ours, mine)}
        for name, tf32 in (("PyTorch, float32", False), ("PyTorch, TF32", True)):
            runs = {batch: functools.partial(theirs, others, batch, tf32) for batch in BATCHES}
            label, run = best(name, runs)
            contenders[label] = run
        contenders["PyTorch, TF32, a frame at a time"] = functools.partial(theirs, others, 1, True)
        tell(f"PSNR, SSIM and LPIPS, {title}", race(contenders, rounds))


def main(args: Args) -> None:
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # PyTorch needs room beside JAX
    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", os.path.join(tempfile.gettempdir(), "xew-benchmark-jax"))
    kind = jax.devices()[0].device_kind
    print(f"{kind}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(format_versions(PACKAGES))
    print(f"{args.frames} frames of {WIDTH}x{HEIGHT}; medians of {args.rounds}; a factor is to ours")
    if args.device not in ("cpu", "cuda") or (args.device == "cuda") != (jax.default_backend() == "gpu"):
        raise SystemExit(
            f"--device {args.device}, but JAX runs on {jax.default_backend()}; set JAX_PLATFORMS, or install jax[cuda]."
        )
    pair = make_pair(args.frames)
    moved = 1 - np.mean(pair.mask & pair.predicted_mask) / np.mean(pair.mask | pair.predicted_mask)
    assert 0.02 < np.mean(pair.mask) < 0.3 and 0.1 < moved < 0.9, "the arm does not look like one"
    on_gpu(pair, args.rounds) if args.device == "cuda" else on_cpu(pair, args.rounds)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
