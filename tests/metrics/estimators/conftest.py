"""Files whose networks are PyTorch's are collected where PyTorch is installed, as `make test-lab` does."""

from importlib.util import find_spec

collect_ignore = [] if find_spec("torch") else ["test_cotracker.py", "test_sam2.py"]
