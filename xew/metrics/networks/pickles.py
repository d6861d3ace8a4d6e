"""Pickles of arrays, read without trusting them: a pickle can run any code."""

import pickle
from collections.abc import Collection
from typing import IO, Any


def read_arrays(file: IO[bytes], admitted: Collection[tuple[str, str]]) -> Any:
    """The object in a pickle of arrays.

    Args:
        file: open for reading.
        admitted: module and name of all that the pickle may call, as it names them; NumPy 2 keeps some elsewhere.

    Raises:
        pickle.UnpicklingError: it asks for anything else, which is not run.
    """
    return _ArrayUnpickler(file, admitted).load()


class _ArrayUnpickler(pickle.Unpickler):
    """An unpickler that builds arrays and what holds them, and nothing else."""

    def __init__(self, file: IO[bytes], admitted: Collection[tuple[str, str]]) -> None:
        super().__init__(file)
        self._admitted = admitted

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._admitted:
            raise pickle.UnpicklingError(f"the file asks for {module}.{name}, which no file of arrays needs; it was not run")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)
