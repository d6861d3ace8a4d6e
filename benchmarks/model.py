"""The reference model beside the PyTorch it comes from: training step, denoising step and autoencoder at full size, one run.

    python -m benchmarks.model [--cases train denoise vae] [--streams 2 3] [--batches 1 2] [--no-peer]

Random weights of Wan2.2-TI2V-5B's shape, clips of 121 frames at 320x256 (31x8x10 tokens a stream), text of 512 tokens.
The peer is diffusers in PyTorch: WanTransformer3DModel in bfloat16 with gradient checkpointing, its blocks under torch.compile
and the faster of PyTorch's attentions (measured first), fused AdamW; it gets as many latent frames as our streams have
together, so that both work on the same number of tokens with full attention among them. Ours: `make_trainer` as
`xew.model.train` uses it, float32 parameters and moments, products in bfloat16. The autoencoder's peer is
AutoencoderKLWan, as its users run it.
Every side runs in a process of its own, one after another, on the same machine.

Before a figure is told, the work is checked: numbers of parameters and tokens, finite losses, shapes of what comes out.
FLOPs are those of the model (`training.flops`, three times forward for training), not what recomputation adds; their share
is of a bfloat16 product of 8192x8192 matrices, measured in the same run.

With several GPUs, `--cases train --no-peer --mesh.data 2` (or `--mesh.fsdp 2`) times the sharded step; `--batches` is per GPU.
"""

import functools
import itertools
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

CONFIG = Path(__file__).parent.parent / "configs" / "wan5b" / "fixed.yaml"
WARMUP, ROUNDS = 2, 5
STEPS_SENT = 5
"""Denoising steps that are sent off before the device is waited for, as a sampler does."""
Case = Literal["train", "denoise", "vae"]


@dataclass(frozen=True)
class MeshArgs:
    data: int = 1
    fsdp: int = 1


@dataclass(frozen=True)
class Args:
    cases: tuple[Case, ...] = ("train", "denoise", "vae")
    streams: tuple[int, ...] = (2, 3)
    """RGB and action, and the robot's render."""
    batches: tuple[int, ...] = (1,)
    """Samples a GPU; each is timed."""
    accumulate: int = 1
    """Ours: parts in which a GPU's samples of a training step are computed, one after another."""
    remat: tuple[str, ...] = ("full",)
    """Ours, each is timed (xew.model.network.blocks.REMAT)."""
    dtypes: tuple[str, ...] = ("bfloat16", "float32")
    """Of the autoencoder; float32 products are rounded to TF32 on both sides, as both do unless told otherwise."""
    vae_chunks: tuple[int, ...] = (0, 8)
    """Ours: latent frames that the autoencoder takes at once, 0 for all; 8 is `xew.model.codecs.codec`'s. Each is timed."""
    mesh: MeshArgs = field(default_factory=MeshArgs)
    size: str = "wan5b"
    """`tiny` to try the script on a CPU."""
    vae: str = "wan22"
    """Key of xew.model.codecs.vae.VAES; `tiny` to try the script on a CPU."""
    frames: int = 121
    peer: bool = True
    side: Literal["", "xew", "diffusers"] = ""
    """Run one side in this process (the command calls itself with it)."""


def main(args: Args) -> int:
    """Print a row a case and side; the number of those that failed."""
    if args.side:
        for result in (xew_side if args.side == "xew" else diffusers_side)(args):
            print("RESULT " + json.dumps(result), flush=True)
        return 0
    failed = 0
    for case in args.cases:
        for side in ("xew", "diffusers") if args.peer else ("xew",):
            environment = os.environ | {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.94"}
            command = [sys.executable, __file__, *sys.argv[1:], "--cases", case, "--side", side]
            with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, encoding="utf-8") as process:
                assert process.stdout is not None
                for line in process.stdout:
                    tell(json.loads(line[7:])) if line.startswith("RESULT ") else print(line, end="", flush=True)
            if process.returncode:
                failed += 1
                print(f"{case}, {side}: ended with {process.returncode}", flush=True)
    return failed


def tell(result: dict[str, Any]) -> None:
    """One row."""
    seconds, flops = result.pop("seconds", None), result.pop("flops", None)
    words = [f"{name} {value}" for name, value in result.items()]
    if seconds:
        words.append(f"{1000 * seconds:.1f} ms")
        words.append(f"{result.get('samples', 1) / seconds:.3f} samples/s")
    if seconds and flops:
        words.append(f"{flops / seconds / 1e12:.0f} model TFLOP/s a GPU")
    print(", ".join(words), flush=True)


def timed(call: Callable[..., Any], *inputs: Any, wait: Callable[[Any], Any], calls: int = 1) -> float:
    """Median seconds of a call, after some that compile; so many are sent off before they are waited for."""
    seconds = []
    for number in range(WARMUP + ROUNDS):
        begin = time.perf_counter()
        for _ in range(calls - 1):
            call(*inputs)
        wait(call(*inputs))
        if number >= WARMUP:
            seconds.append((time.perf_counter() - begin) / calls)
    return statistics.median(seconds)


def or_out_of_memory(measure: Callable[[], dict[str, Any]], row: dict[str, Any]) -> dict[str, Any]:
    """A row with what was measured; that a case does not fit into memory is a result too."""
    try:
        return row | measure()
    except Exception as error:  # each framework has its own
        if "out of memory" not in str(error).lower():
            raise
        return row | {"failed": "out of memory"}


# ---- our side


def xew_side(args: Args) -> Iterator[dict[str, Any]]:
    import jax

    device = jax.devices()[0]
    print(f"{device.device_kind} x {len(jax.devices())}, " + ", ".join(f"{p} {version(p)}" for p in ("jax", "flax")))
    yield {"side": "xew"} | jax_product()
    for case in args.cases:
        yield from {"train": xew_train, "denoise": xew_denoise, "vae": xew_vae}[case](args)


def jax_product() -> dict[str, Any]:
    """A chain of products of square bfloat16 matrices, the most that the device does."""
    import jax
    import jax.numpy as jnp

    side = 8192 if jax.devices()[0].platform == "gpu" else 512
    a = jax.random.normal(jax.random.key(0), (side, side), jnp.bfloat16)
    chain = jax.jit(lambda a: jax.lax.fori_loop(0, 20, lambda _, b: a @ b * (1 / 128), a))
    seconds = timed(chain, a, wait=jax.block_until_ready) / 20
    return {"case": f"bf16 product of {side}x{side}", "seconds": seconds, "flops": 2 * side**3}


def experiment_of(args: Args, streams: int, batch: int, remat: str, *more: str) -> Any:
    from xew.model.experiment import load_experiment

    size = [f"--model.size={args.size}", f"--clip.frames={args.frames}", f"--train.batch={batch}"]
    embodiment = f"--model.embodiment={'robot_render' if streams == 3 else 'none'}"
    mesh = [f"--mesh.data={args.mesh.data}", f"--mesh.fsdp={args.mesh.fsdp}"]
    return load_experiment(CONFIG, [*size, embodiment, f"--model.remat={remat}", *mesh, "--train.chunks=1", *more])


def forward_flops(experiment: Any, samples: int, **options: Any) -> float:
    from xew.model.network.dit import MODELS
    from xew.model.training.flops import flops

    return flops(MODELS[experiment.model.size], experiment.inputs.grids, batch=samples, **options)


def check_size(args: Args, parameters: int) -> None:
    """Streams add their patch embeddings to the published 4,999,787,712 parameters."""
    assert args.size != "wan5b" or 4_999_787_712 <= parameters < 5_003_000_000, f"{parameters:,} parameters"


def peak_memory() -> float:
    """[GB] of the first device."""
    import jax

    return round(((jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)) / 1e9, 1)


def xew_train(args: Args) -> Iterator[dict[str, Any]]:
    for streams, remat, batch in itertools.product(args.streams, args.remat, args.batches):
        row = {"side": "xew", "case": "train", "streams": streams, "batch a GPU": batch, "remat": remat}
        row |= {"accumulate": args.accumulate, "mesh": f"{args.mesh.data}x{args.mesh.fsdp}"}
        devices = args.mesh.data * args.mesh.fsdp
        accumulate = f"--train.accumulate={args.accumulate}"
        experiment = experiment_of(args, streams, batch * devices, remat, accumulate)
        yield or_out_of_memory(functools.partial(xew_train_step, args, experiment, batch), row)


def xew_train_step(args: Args, experiment: Any, batch: int) -> dict[str, Any]:
    """Seconds of a step whose state stays on the devices; `batch` is a GPU's."""
    import jax

    from xew.model.devices.sharding import make_mesh, place_batch
    from xew.model.training.data import fake_batch
    from xew.model.training.step import make_trainer

    devices = jax.devices()[: args.mesh.data * args.mesh.fsdp]
    mesh = make_mesh(experiment.mesh, devices)
    trainer = make_trainer(experiment.spec, mesh)
    state = trainer.init_state()
    check_size(args, sum(leaf.size for leaf in jax.tree.leaves(state.params)))
    samples = place_batch(fake_batch(experiment.inputs, batch * len(devices)), mesh)
    seconds = []
    for _ in range(WARMUP + ROUNDS):
        begin = time.perf_counter()
        state, result = trainer.step(state, samples)
        assert np.isfinite(jax.device_get(result.losses)).all(), "the loss is not finite"
        seconds.append(time.perf_counter() - begin)
    measured = {"samples": batch * len(devices), "first step s": round(seconds[0], 1), "peak GB": peak_memory()}
    flops = 3 * forward_flops(experiment, batch)
    return measured | {"seconds": statistics.median(seconds[WARMUP:]), "flops": flops}


def xew_denoise(args: Args) -> Iterator[dict[str, Any]]:
    import jax
    import jax.numpy as jnp
    from flax import nnx

    from xew.model.network.dit import WorldModel, cast_params, network_graph
    from xew.model.training.data import fake_batch

    for streams, visibility in itertools.product(args.streams, ("joint", "one_way")):
        experiment = experiment_of(args, streams, 1, "none", f"--model.visibility={visibility}")
        network = experiment.network.for_sampling
        graph = network_graph(network)
        params = jax.jit(lambda n=network, g=graph: cast_params(g, nnx.state(WorldModel(n), nnx.Param)))()
        fill = jax.jit(lambda p, b, g=graph: nnx.merge(g, p).condition_cache(b.conditions, b.text))
        step = jax.jit(lambda p, b, c, s, g=graph: nnx.merge(g, p)(b.latents, b.conditions, s, b.text, c))
        for samples in args.batches:
            row = {"side": "xew", "streams": streams, "samples": samples, "visibility": visibility}
            batch, sigma, cache = jax.device_put(fake_batch(experiment.inputs, samples)), jnp.full(samples, 0.5), None
            if visibility == "one_way":
                seconds = timed(fill, params, batch, wait=jax.block_until_ready)
                yield row | {"case": "condition cache, once a clip", "seconds": seconds}
                cache = fill(params, batch)
            out = step(params, batch, cache, sigma)
            assert out.shape == batch.latents.shape and bool(jnp.isfinite(out).all())
            seconds = timed(step, params, batch, cache, sigma, wait=jax.block_until_ready, calls=STEPS_SENT)
            flops = forward_flops(experiment, samples, visibility=visibility, cached=cache is not None)
            yield row | {"case": "denoise", "peak GB": peak_memory(), "seconds": seconds, "flops": flops}
        del params, cache


def xew_vae(args: Args) -> Iterator[dict[str, Any]]:
    import jax
    from flax import nnx

    from xew.model.codecs.vae import VAES, VideoVae

    frames = jax.random.uniform(jax.random.key(0), (1, args.frames, 256, 320, 3), minval=-1, maxval=1)
    size = VAES[args.vae]
    for dtype in args.dtypes:
        graph = nnx.split(nnx.eval_shape(lambda s=size, d=dtype: VideoVae(s, dtype=d, rngs=nnx.Rngs(0))))[0]
        state = jax.jit(lambda s=size, d=dtype: nnx.split(VideoVae(s, dtype=d, rngs=nnx.Rngs(0)))[1])()
        for chunk in args.vae_chunks:
            row = {"side": "xew", "dtype": dtype, "latent frames at once": chunk or "all"}
            encode = jax.jit(lambda p, x, g=graph, c=chunk: nnx.merge(g, p).encode(x, c))
            decode = jax.jit(lambda p, z, g=graph, c=chunk: nnx.merge(g, p).decode(z, c))
            latents = jax.numpy.zeros(latent_shape(args, size))
            passes = {"encode": (encode, frames, latents.shape), "decode": (decode, latents, frames.shape)}
            for case, (call, given, shape) in passes.items():
                yield or_out_of_memory(functools.partial(vae_pass, call, state, given, shape), row | {"case": case})


def latent_shape(args: Args, size: Any) -> tuple[int, ...]:
    return 1, (args.frames - 1) // 4 + 1, 256 // size.spatial_factor, 320 // size.spatial_factor, size.channels


def vae_pass(call: Callable[..., Any], state: Any, given: Any, shape: tuple[int, ...]) -> dict[str, Any]:
    """Seconds of encoding or decoding."""
    import jax
    import jax.numpy as jnp

    out = call(state, given)
    assert out.shape == shape and bool(jnp.isfinite(out.astype(jnp.float32)).all())
    return {"seconds": timed(call, state, given, wait=jax.block_until_ready), "peak GB": peak_memory()}


# ---- diffusers' side

LATENT = (31, 16, 20)


def diffusers_side(args: Args) -> Iterator[dict[str, Any]]:
    import torch

    torch.set_float32_matmul_precision("high")
    torch.backends.cudnn.benchmark = True
    where = "cuda" if torch.cuda.is_available() else "cpu"
    name = torch.cuda.get_device_name() if where == "cuda" else "CPU"
    print(f"{name}, " + ", ".join(f"{p} {version(p)}" for p in ("torch", "diffusers")))
    for case in args.cases:
        yield from {"train": peer_train, "denoise": peer_denoise, "vae": peer_vae}[case](args, where)


def peer_model(args: Args, where: str) -> Any:
    import torch
    from diffusers import WanTransformer3DModel

    from xew.model.network.dit import MODELS

    size = MODELS[args.size]
    config = {"patch_size": (1, 2, 2), "in_channels": 48, "out_channels": 48, "freq_dim": 256, "num_layers": size.depth}
    config |= {"num_attention_heads": size.heads, "attention_head_dim": size.head_dim, "ffn_dim": size.ffn_dim}
    with torch.device(where):
        torch.manual_seed(0)
        model = WanTransformer3DModel(**config, text_dim=size.text_dim).to(torch.bfloat16)
    assert args.size != "wan5b" or sum(p.numel() for p in model.parameters()) == 4_999_787_712
    return model


def peer_inputs(args: Args, streams: int, batch: int, where: str) -> dict[str, Any]:
    """As many latent frames as all streams have, and a time for every token, as TI2V has."""
    import torch

    from xew.model.network.dit import MODELS

    size = MODELS[args.size]
    frames, h, w = ((args.frames - 1) // 4 + 1) * streams, *LATENT[1:]
    tokens = frames * h * w // 4
    return {
        "hidden_states": torch.randn(batch, 48, frames, h, w, device=where, dtype=torch.bfloat16),
        "timestep": torch.full((batch, tokens), 500.0, device=where),
        "encoder_hidden_states": torch.randn(batch, size.text_tokens, size.text_dim, device=where, dtype=torch.bfloat16),
        "return_dict": False,
    }


def best_attention(model: Any, inputs: dict[str, Any]) -> str:
    """The faster of PyTorch's flash and cuDNN attention for this model, which is left set."""
    import torch

    seconds = {}
    for backend in ("native", "_native_flash", "_native_cudnn"):
        try:
            model.set_attention_backend(backend)
            with torch.no_grad():
                seconds[backend] = timed(functools.partial(model, **inputs), wait=wait_for_torch)
        except (RuntimeError, ValueError) as error:
            print(f"diffusers: attention {backend} cannot be used: {str(error).splitlines()[0]}")
    best = min(seconds, key=lambda name: seconds[name])
    model.set_attention_backend(best)
    return best


def wait_for_torch(_: Any) -> None:
    import torch

    if torch.cuda.is_available():
        torch.cuda.synchronize()


def peer_train(args: Args, where: str) -> Iterator[dict[str, Any]]:
    import torch

    model = peer_model(args, where)
    best = best_attention(model, peer_inputs(args, max(args.streams), 1, where))
    model.enable_gradient_checkpointing()
    model.train()
    model.compile_repeated_blocks(fullgraph=True)
    optimizer = torch.optim.AdamW(model.parameters(), lr=5e-5, weight_decay=0.01, fused=where == "cuda")
    for streams, batch in itertools.product(args.streams, args.batches):
        row = {"side": "diffusers", "case": "train", "streams": streams, "batch a GPU": batch, "attention": best}
        inputs = peer_inputs(args, streams, batch, where)
        flops = 3 * peer_flops(args, streams, batch)
        yield or_out_of_memory(functools.partial(peer_train_step, model, optimizer, inputs), row) | {"flops": flops}


def peer_train_step(model: Any, optimizer: Any, inputs: dict[str, Any]) -> dict[str, Any]:
    """Seconds of a step: forward, backward, clipping, update."""
    import torch

    torch._dynamo.reset()
    target = torch.randn_like(inputs["hidden_states"])

    def step() -> Any:
        loss = (model(**inputs)[0].float() - target.float()).square().mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        return loss

    begin = time.perf_counter()
    assert torch.isfinite(step()), "the loss is not finite"
    wait_for_torch(None)
    measured = {"samples": len(target), "first step s": round(time.perf_counter() - begin, 1)}
    return measured | {"seconds": timed(step, wait=wait_for_torch), "peak GB": peer_memory()}


def peer_flops(args: Args, streams: int, samples: int) -> float:
    from xew.model.network.dit import MODELS
    from xew.model.training.flops import flops

    grid = ((args.frames - 1) // 4 + 1, LATENT[1] // 2, LATENT[2] // 2)
    return flops(MODELS[args.size], [grid] * streams, batch=samples)


def peer_memory() -> float:
    import torch

    return round(torch.cuda.max_memory_allocated() / 1e9, 1) if torch.cuda.is_available() else 0.0


def peer_denoise(args: Args, where: str) -> Iterator[dict[str, Any]]:
    import torch

    model = peer_model(args, where).eval()
    best = best_attention(model, peer_inputs(args, max(args.streams), 1, where))
    model.compile_repeated_blocks(fullgraph=True)
    for streams, samples in itertools.product(args.streams, args.batches):
        torch._dynamo.reset()
        inputs = peer_inputs(args, streams, samples, where)
        with torch.no_grad():
            out = model(**inputs)[0]
            assert out.shape == inputs["hidden_states"].shape and bool(torch.isfinite(out).all())
            seconds = timed(functools.partial(model, **inputs), wait=wait_for_torch, calls=STEPS_SENT)
        row = {"side": "diffusers", "case": "denoise", "streams": streams, "samples": samples, "attention": best}
        yield row | {"peak GB": peer_memory(), "seconds": seconds, "flops": peer_flops(args, streams, samples)}


WAN22_VAE = {"base_dim": 160, "decoder_base_dim": 256, "z_dim": 48, "num_res_blocks": 2}
SMALL_VAE = {"base_dim": 16, "decoder_base_dim": 16, "z_dim": 4, "num_res_blocks": 1}


def peer_vae(args: Args, where: str) -> Iterator[dict[str, Any]]:
    import torch
    from diffusers import AutoencoderKLWan

    widths = WAN22_VAE if args.vae == "wan22" else SMALL_VAE
    config = widths | {"dim_mult": [1, 2, 4, 4], "is_residual": True, "in_channels": 12, "out_channels": 12, "patch_size": 2}
    config |= {"scale_factor_spatial": 16, "scale_factor_temporal": 4, "temperal_downsample": [False, True, True]}
    config |= {"latents_mean": [0.0] * widths["z_dim"], "latents_std": [1.0] * widths["z_dim"]}
    for dtype in args.dtypes:
        with torch.device(where):
            vae = AutoencoderKLWan(**config).to(getattr(torch, dtype)).eval()
        assert args.vae != "wan22" or sum(p.numel() for p in vae.parameters()) == 704_688_668
        frames = torch.rand(1, 3, args.frames, 256, 320, device=where, dtype=getattr(torch, dtype)) * 2 - 1
        with torch.no_grad():
            latents = vae.encode(frames).latent_dist.mode()
            assert vae.decode(latents).sample.shape == frames.shape
            row = {"side": "diffusers", "dtype": dtype, "latents": list(latents.shape)}
            yield row | {"case": "encode", "seconds": timed(vae.encode, frames, wait=wait_for_torch)}
            seconds = timed(vae.decode, latents, wait=wait_for_torch)
            yield row | {"case": "decode", "seconds": seconds, "peak GB": peer_memory()}


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args, description=__doc__)))
