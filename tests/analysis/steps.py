"""Commands that cost nothing, for tests of the study runner: `python -m tests.analysis.steps FILE TEXT ...`."""

import argparse
import sys
import time
from pathlib import Path

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=Path)
    parser.add_argument("text")
    parser.add_argument("--wait", type=float, default=0.0)
    parser.add_argument("--until", type=Path, help="wait until this file exists, half a minute at most")
    parser.add_argument("--fail", action="store_true")
    args, _ = parser.parse_known_args()
    with args.file.with_suffix(".begun").open("a") as begun:
        begun.write(f"{args.text}\n")
    time.sleep(args.wait)
    give_up = time.monotonic() + 30
    while args.until and not args.until.exists():
        if time.monotonic() > give_up:
            sys.exit(f"error: {args.until} did not come")
        time.sleep(0.05)
    if args.fail:
        sys.exit("error: the disk is made of cheese")
    args.file.write_text(args.text)
