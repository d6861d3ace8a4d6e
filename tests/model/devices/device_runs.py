"""Run by test_many_devices.py in processes of their own, for a process has its devices for good.

python device_runs.py JOBS: a JSON list of {"devices": 2, "arguments": [... of xew.model.train], "kill": true}; each is run on
the first so many of this process's devices, and `kill` ends the process without warning once the first checkpoint is there.
"""

import functools
import json
import os
import signal
import sys
from typing import Any

import jax

from xew.model import train
from xew.model.devices import sharding
from xew.model.training import loop


def run(devices: int, arguments: list[str], kill: bool = False) -> None:
    train.make_mesh = lambda settings: sharding.make_mesh(settings, jax.devices()[:devices])
    if kill:
        loop.save_state = functools.partial(save_and_die, loop.save_state)
    train.main(arguments)


def save_and_die(save: Any, checkpoints: Any, *rest: Any) -> None:
    save(checkpoints, *rest)
    checkpoints.wait_until_finished()
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    for job in json.loads(sys.argv[1]):
        run(**job)
