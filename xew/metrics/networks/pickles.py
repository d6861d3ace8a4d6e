"""Files of arrays and tensors that are pickles, read without trusting them: a pickle can run any code.

Readers of pickles raise any type of error for bytes that are none, so each of these functions raises one.
"""

import importlib
import pickle
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import IO, Any

from xew.config import ConfigError
from xew.files import demand_regular

SHOWN_LETTERS = 40
"""Number of letters of a text that was downloaded instead of a checkpoint, in a message."""


def read_arrays(file: IO[bytes], admitted: Collection[tuple[str, str]]) -> Any:
    """The object in a pickle of arrays.

    Args:
        file: open for reading.
        admitted: module and name of all that the pickle may call, as it names them; NumPy 2 keeps some elsewhere.

    Raises:
        pickle.UnpicklingError: it is damaged, or asks for anything else, which is not run.
    """
    try:
        return _ArrayUnpickler(file, admitted).load()
    except pickle.UnpicklingError:
        raise
    except Exception as error:
        raise pickle.UnpicklingError(f"it is no whole pickle of arrays ({first_line(error)})") from error


class _ArrayUnpickler(pickle.Unpickler):
    """An unpickler that builds arrays and what holds them, and nothing else."""

    def __init__(self, file: IO[bytes], admitted: Collection[tuple[str, str]]) -> None:
        super().__init__(file)
        self._admitted = admitted

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._admitted:
            raise pickle.UnpicklingError(f"the file asks for {module}.{name}, which no file of arrays needs; it was not run")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def read_torch_file(path: Path, user: str) -> Any:
    """The tensors in a file of PyTorch and what holds them, on the CPU.

    Args:
        path: of the file.
        user: name of the network or library in error messages.

    Raises:
        ImportError: PyTorch is not installed.
        ConfigError: the file cannot be read, is no whole checkpoint, or holds anything else, which is not run.
    """
    torch = importlib.import_module("torch")
    try:
        demand_regular(path)
        return torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except Exception as error:
        raise ConfigError(f"{path} is no whole checkpoint of {user}: {_explain(path, error)}; download it again.") from error


def _explain(path: Path, error: Exception) -> str:
    """What a file holds instead of a checkpoint; servers and Git LFS leave short texts in its place."""
    if isinstance(error, OSError):
        return first_line(error)
    with path.open("rb") as file:
        start = file.read(SHOWN_LETTERS).decode(errors="replace")
    if not start:
        return "it is empty"
    if "\0" not in start and "\ufffd" not in start:
        return f"it is a text that begins with {start!r}"
    is_refused = isinstance(error, pickle.UnpicklingError)  # its message advises to trust the file
    return "it holds more than tensors, or is damaged" if is_refused else first_line(error)


def first_line(error: Exception) -> str:
    """The first line of an error's message, or its type without one."""
    return (str(error).splitlines() or [type(error).__name__])[0][:160]
