"""Runs the cells of a city on a Ray cluster, the largest first, and merges them.

    pip install ray
    ray start --head                                   # on one machine; `ray start --address HEAD:6379` on the others
    python ray_job.py city --out runs/city --spill-dir /nvme -- --host-mem 24GiB

The folder of the city, and the scene, must have the same paths on all machines. What follows `--` is given to `gsscale-cells run`. A cell whose
machine is lost, or that asks for another attempt (exit code 75), goes on elsewhere from its last copy. Start the job again to go on after a
failure: cells that are done stay done.
"""

import argparse
import os
import pathlib
import subprocess
import sys
import time
import tomllib

import ray

PROGRAM = os.environ.get("GSSCALE_CELLS", "gsscale-cells")
AGAIN = 75
TAKEN = 76
# Seconds between attempts where another process has the cell: the lock of a machine that is lost counts for 90.
PAUSE = 30


class TryAgain(Exception):
    """The cell may succeed in another attempt."""


def run_cell(city: str, cell: int, flags: list[str]) -> int:
    command = [PROGRAM, "run", city, "--cell", str(cell), "--quiet", *flags]
    # Waiting for another process that has the cell is no attempt.
    while (code := subprocess.run(command, check=False).returncode) == TAKEN:
        time.sleep(PAUSE)
    # A signal that nobody handled, such as that of a machine without memory, gives a negative code.
    if code == AGAIN or code < 0:
        raise TryAgain(f"cell {cell}: exit code {code}")
    return code


def main() -> int:
    parser = argparse.ArgumentParser(description="Runs the cells of a city on a Ray cluster.")
    parser.add_argument("city", help="folder of the city, which `gsscale-cells cut` has cut")
    parser.add_argument("--out", help="merge the cells into this new folder")
    parser.add_argument("--spill-dir", help="folder on a fast drive of each machine")
    parser.add_argument("--gpus", type=float, default=0, help="GPUs of a cell")
    parser.add_argument("--cpus", type=float, default=1, help="CPU cores of a cell")
    parser.add_argument("--memory", type=float, default=0, help="memory of a cell, GiB")
    parser.add_argument("--attempts", type=int, default=10, help="attempts for each cell")
    own = sys.argv[1 : sys.argv.index("--")] if "--" in sys.argv else sys.argv[1:]
    args = parser.parse_args(own)
    city = str(pathlib.Path(args.city).absolute())
    flags = [*sys.argv[len(own) + 2 :], *(["--spill-dir", args.spill_dir] if args.spill_dir else [])]
    cells = tomllib.loads(pathlib.Path(city, "plan.toml").read_text())["cells"]
    ray.init(address=os.environ.get("RAY_ADDRESS"), log_to_driver=True)
    needs = {"num_cpus": args.cpus, "num_gpus": args.gpus, "memory": int(args.memory * 2**30)}
    task = ray.remote(run_cell).options(**needs, max_retries=args.attempts, retry_exceptions=[TryAgain])
    largest_first = sorted(range(len(cells)), key=lambda cell: -cells[cell]["seconds"])
    open_tasks = {task.remote(city, cell, flags): cell for cell in largest_first}
    failed = []
    while open_tasks:
        ended, _ = ray.wait(list(open_tasks), timeout=60)
        for reference in ended:
            cell = open_tasks.pop(reference)
            try:
                code = ray.get(reference)
            except Exception as error:  # of Ray, or the last attempt
                code = (str(error).splitlines() or [repr(error)])[-1]
            if code != 0:
                failed.append(f"cell {cell}: {code}")
        subprocess.run([PROGRAM, "status", city], check=False)
    if failed:
        print("not done: " + "; ".join(failed), file=sys.stderr)
        return 1
    return subprocess.run([PROGRAM, "merge", city, "--out", args.out], check=False).returncode if args.out else 0


if __name__ == "__main__":
    sys.exit(main())
