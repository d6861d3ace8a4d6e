"""The entry point: `python -m xew` lists all commands (COMMANDS), and `xew train CONFIG` is `python -m xew.model.train CONFIG`.

`xew` is the same as `python -m xew`. To add a command, add one line to COMMANDS, in the order of the pipeline.
"""

import runpy
import sys

from xew import __version__
from xew.config import suggestion

COMMANDS = {
    "adopt": ("xew.sim_warp.robots.adopt", "complete a robot's URDF or xacro, so every other command takes it"),
    "generate": ("xew.sim_warp.generate", "make episodes: paired data of tasks, seeds and robots"),
    "import-robotwin": ("xew.exchange.robotwin", "import RoboTwin 2.0 episodes"),
    "export-lerobot": ("xew.exchange.lerobot", "export episodes as a LeRobotDataset"),
    "inspect": ("xew.sim_warp.inspect", "verify a data set, draw contact sheets, build the explorer page"),
    "latents": ("xew.model.latents", "encode the episodes of a config"),
    "train": ("xew.model.train", "train a world model"),
    "rollout": ("xew.model.rollout", "predict episodes with a trained model"),
    "simulate": ("xew.model.simulate", "run a policy inside a trained model"),
    "outside": ("xew.model.outside", "predict episodes with any other model"),
    "export": ("xew.model.export", "write a run's weights with diffusers' or Wan's names"),
    "release": ("xew.model.release", "package a run's network with its codec, config and model card"),
    "evaluate": ("xew.metrics.evaluate", "grade predicted videos"),
    "report": ("xew.analysis.report", "make a report page of scores"),
    "study": ("xew.analysis.study", "run a whole study: data, runs, scores and report"),
    "study-analyse": ("xew.analysis.study_analyse", "merge a study's scores and make its report"),
    "distance": ("xew.analysis.distance", "measure the distances between robots"),
}
"""Module and purpose of each command."""


def main() -> None:
    """Run the command that the first argument names; without one, list the commands."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help"):
        print(f"usage: xew COMMAND [...]\n\n{__doc__.splitlines()[0]}\n")
        print("\n".join(f"  {command:16s}{purpose}" for command, (_, purpose) in COMMANDS.items()))
        print("\n`xew COMMAND --help` lists the options of a command.")
    elif name == "--version":
        print(f"xew {__version__}")
    elif name in COMMANDS:
        del sys.argv[1]
        runpy.run_module(COMMANDS[name][0], run_name="__main__", alter_sys=True)
    else:
        print(f"error: unknown command {name!r};{suggestion(name, COMMANDS)} known: {', '.join(COMMANDS)}.", file=sys.stderr)
        raise SystemExit(2)


if __name__ == "__main__":
    main()
