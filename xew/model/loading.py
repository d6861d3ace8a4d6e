"""Loading of trained models for prediction: from a run, or from a config that names published weights."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from xew.compilation import keep_compiled_programs
from xew.config import ConfigError, is_packaged
from xew.model.cache.scales import Scale, load_run_scales
from xew.model.cache.store import load_codec
from xew.model.codecs.contract import Codec
from xew.model.devices.sharding import MeshSettings, make_mesh, replicated_sharding
from xew.model.experiment import Experiment
from xew.model.network.dit import cast_params, network_graph
from xew.model.network.dit_layouts import load_dit_params
from xew.model.runs.checkpoint import load_params
from xew.model.runs.folder import load_run_codec
from xew.model.sampling.predict import Predictor, make_predictor
from xew.model.training.step import make_trainer


def open_predictor(run: Path, experiment: Experiment, step: int | None) -> Predictor:
    """`load_predictor` in a process that begins; its compiled programs are cached."""
    keep_compiled_programs()
    return load_predictor(run, experiment, step)[0]


def load_predictor(run: Path, experiment: Experiment, step: int | None = None) -> tuple[Predictor, int | None]:
    """Load a run's model on each device, with the step of its checkpoint, or a config's published weights with step None.

    Args:
        run: folder of the run, or the config.
        experiment: its config, perhaps with other sampling settings.
        step: of the checkpoint, by default the latest.

    Raises:
        ConfigError: there is no such checkpoint, or there are no such weights.
    """
    if is_config(run):
        return load_published(experiment, run), None
    mesh, codec = make_mesh(MeshSettings()), load_run_codec(run, experiment.codec)
    params, step = load_params(run, experiment.network, step, replicated_sharding(mesh))
    scales = load_run_scales(experiment.conditions, run)
    return _place_predictor(experiment, codec, params, mesh, scales), step


def _place_predictor(experiment: Experiment, codec: Codec, params: Any, mesh: Mesh, scales: Mapping[str, Scale]) -> Predictor:
    """The predictor with parameters in the types of their products, and a copy of the codec on each device."""
    params = jax.jit(cast_params, static_argnums=0)(network_graph(experiment.network.for_sampling), params)
    return make_predictor(experiment, jax.device_put(codec, replicated_sharding(mesh)), params, scales)


def is_config(run: Path) -> bool:
    """Whether a path is a config with published weights, not the folder of a run."""
    return run.suffix in (".yaml", ".yml") or is_packaged(run)


def load_published(experiment: Experiment, source: Path) -> Predictor:
    """A config's network with its published weights.

    Raises:
        ConfigError: the config names no weights, or needs scales of training episodes.
    """
    if experiment.model.weights is None:
        raise ConfigError(f"{source} names no model.weights; set it to published weights, or give the folder of a run.")
    scaled = [condition.name for condition in experiment.conditions.values() if condition.scale != "none"]
    if scaled:
        raise ConfigError(f"{source}: {', '.join(scaled)} is scaled by training episodes; train a run and roll that out.")
    mesh = make_mesh(MeshSettings())
    graph, params = make_trainer(experiment.spec, mesh).random_network()
    params = load_dit_params(graph, params, experiment.model.weights)
    return _place_predictor(experiment, load_codec(experiment.encoding), params, mesh, {})
