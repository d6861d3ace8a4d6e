"""Machines of a study that do each step in the test's own process: its real commands, without starting processes for them."""

from pathlib import Path

from tests.commands import run_command
from xew.analysis.studies.plan import Step
from xew.analysis.studies.processes import wait_for_lock


class InlineMachines:
    """Machines whose steps are done as soon as they were started; one that fails ends the test with what it printed.

    Programs, weights and imports are then shared by all steps. test_study_runner.py tests what steps are in processes of their
    own.
    """

    slots = 1

    def __init__(self) -> None:
        self._ended: list[tuple[str, int]] = []

    def has_room_for(self, step: Step) -> bool:
        """Whether nothing is left to be noticed."""
        return not self._ended

    def start(self, step: Step, command: tuple[str, ...], log: Path, among: int) -> None:
        """Do a step, after whoever is still left of it from a killed study; its output lies where a process's would."""
        log.parent.mkdir(parents=True, exist_ok=True)
        with wait_for_lock(log.with_suffix(".lock")):
            log.write_text(run_command(*command))
        self._ended.append((step.name, 0))

    def wait(self) -> list[tuple[str, int]]:
        """The step that was done last, and its exit status."""
        ended, self._ended = self._ended, []
        return ended

    def stop(self) -> None:
        """Nothing runs in the background."""
