"""Export of a run's network for other projects, under the weight names of diffusers or of Wan's code.

Reads  a run's checkpoint (the moving average if there is one, with LoRA corrections added)
Writes a folder of safetensors with config.json for `WanTransformer3DModel.from_pretrained`, or one .safetensors
Command: python -m xew.model.export RUN --out FOLDER [--naming official] [--dtype bfloat16]
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import tyro
from flax import nnx

from xew.config import ConfigError, admit, user_errors
from xew.files import hold_lock
from xew.model.network.dit import network_graph, parameter_count
from xew.model.network.dit_layouts import Naming, save_dit, wan_layout
from xew.model.network.tokens import WAVELENGTH_BASE
from xew.model.runs.checkpoint import load_params
from xew.model.runs.folder import load_run_config
from xew.model.weights.layout import checkpoint_shapes


def export(run: Path, out: Path, naming: Naming = "diffusers", dtype: str = "float32", step: int | None = None) -> int:
    """Write the network of a run, and return the step of its checkpoint.

    Raises:
        ConfigError: there is no such run or checkpoint, or `out` exists or cannot be written.
    """
    experiment = load_run_config(run)
    if out.exists() and (out.is_file() or any(out.iterdir())):
        raise ConfigError(f"{out} exists already; choose another --out.")
    params, step = load_params(run, experiment.network, step)
    model = nnx.merge(network_graph(experiment.network), jax.tree.map(lambda leaf: leaf.astype(jnp.dtype(dtype)), params))
    save_dit(model, out, naming)
    total = parameter_count(model)
    added = total - sum(math.prod(shape) for shape in checkpoint_shapes(model, wan_layout(model, naming)).values())
    extra = f"; {added:,} of them belong to streams, mechanisms or words, which Wan does not have" if added else ""
    print(f"{out}: {total:,} parameters of step {step} under the names of {naming}, {dtype}{extra}")
    base = experiment.size.rotary_base
    if base != WAVELENGTH_BASE:
        print(f"its rotary positions have base {base:g}; code with Wan's base {WAVELENGTH_BASE:g} gives other results")
    if (prediction := experiment.model.prediction) != "velocity":
        print(f"its output is the {prediction}, not the velocity; samplers of the velocity cannot use it directly")
    return step


@dataclass(frozen=True)
class Args:
    """Options of the export."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a trained run."""
    out: Path
    """Folder, or a file that ends in .safetensors."""
    naming: Naming = "diffusers"
    """Names of the weights: diffusers' or Wan's."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the weights."""
    checkpoint: int | None = None
    """Step of the checkpoint (default: the latest)."""
    trust: tuple[str, ...] = ()
    """Custom modules, such as my_lab.models, that the run may name."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Write the network of a run."""
    args = tyro.cli(Args, args=arguments, prog="python -m xew.model.export", description=__doc__.splitlines()[0])
    admit(args.trust)
    with hold_lock(args.out):
        export(args.run, args.out, args.naming, args.dtype, args.checkpoint)


if __name__ == "__main__":
    main()
