"""A disk that is full, one that is read-only and a folder of another user: real ones, in a mount namespace of their own."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
NAMESPACE = ("unshare", "--mount") if os.geteuid() == 0 else ("unshare", "--mount", "--map-root-user")
CAUSES = {"full": "No space left on device", "read-only": "Read-only file system", "another user's": "Permission denied"}
"""What is said, by disk."""


def test_what_a_disk_refuses_is_one_line_and_nothing_is_lost(record_property: Any) -> None:
    with tempfile.TemporaryDirectory(prefix="xew-disk-") as folder:  # where another user gets, too
        try:
            mount = ("mount", "-t", "tmpfs", "tmpfs", folder)
            subprocess.run([*NAMESPACE, *mount], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"this machine lets no process mount a disk of its own ({error})")
        command = [*NAMESPACE, sys.executable, "-m", "tests.faults.small_disk", folder]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    tried = [json.loads(line) for line in done.stdout.splitlines()]
    assert [one for one in tried if one["status"] != 2] == [], done.stderr
    assert {one["disk"] for one in tried} == set(CAUSES) and len(tried) >= 24, len(tried)
    for one in tried:
        assert one["kept"] and not one["left"], one
        assert len(one["said"]) == 1 and one["said"][0].startswith("error: ") and CAUSES[one["disk"]] in one["said"][0], one
    record_property("tried writers on refusing disks", len(tried))
