"""Running `python -m xew...` inside the process of a test: the same arguments and exit status, without a new interpreter."""

import io
import os
import runpy
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest


def run_command(module: str, *arguments: str | Path) -> str:
    """What `python -m module arguments` prints; it must end well."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(said), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of runpy: the module may have been imported before
        patch.setattr(sys, "argv", [module, *map(str, arguments)])
        try:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        except SystemExit as stop:
            assert not stop.code, f"{module} ended with {stop.code}:\n{said.getvalue()}"
    return said.getvalue()


def on_devices(count: int) -> dict[str, str]:
    """Variables of a process that has so many CPU devices and compiles as the tests do."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={count}"
    return {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
