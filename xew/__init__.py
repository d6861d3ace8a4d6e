"""xew: can an action-conditioned world model render a robot that it has never seen?

Packages, in the order in which the data flows (docs/architecture.md):
    sim_warp   (task, seed)         -> episodes      paired data, Newton and Warp
    model      episodes             -> rollouts      video-diffusion world model, JAX
    metrics    prediction, target   -> scores        jitted functions, JAX
    analysis   scores               -> claims        tables, figures, report
The contracts between them: `xew.episode` (what an episode holds) and `xew.protocol` (who is held out).
"""

import os
import sys

__version__ = "0.2.0"


def _leave_current_folder() -> None:
    """Take the current folder off the module path of a command and of its child processes.

    `python -m` searches it first, so a `cv2.py` in a data set would run. It stays where xew itself lies there, as in a clone.
    Modules that the user names are still found in it (`xew.config.import_named`).
    """
    folder = os.getcwd()
    if os.path.samefile(folder, os.path.dirname(os.path.dirname(os.path.abspath(__file__)))):
        return
    if sys.path[:1] == [folder]:
        del sys.path[0]
    os.environ["PYTHONSAFEPATH"] = "1"


def _is_command() -> bool:
    """Whether this process was started as `python -m xew...` or `xew`."""
    started = os.path.basename((sys.argv or [""])[0])
    if started != "-m":  # which it is while Python looks for the module
        return started == "xew"
    following = sys.orig_argv[sys.orig_argv.index("-m") + 1 :] if "-m" in sys.orig_argv else []
    return following[0].partition(".")[0] == "xew" if following else False


if _is_command():
    _leave_current_folder()
