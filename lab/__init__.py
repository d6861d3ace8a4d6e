"""The laboratory: what makes and measures the package's own assets. It stays outside the wheel; run it from a clone.

    python -m lab.COMMAND        each file or package here is one tool; its first lines say what it makes

`lab` may import anything of `xew`; `xew` imports nothing of `lab`. `make test-lab` runs its tests.
"""
