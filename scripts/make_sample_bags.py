"""Make the recordings in sample_bags/ anew: `python scripts/make_sample_bags.py`."""

from pathlib import Path

from calibkit.cli.progress import bar
from calibkit.stages.simulate import simulate

LARGEST = 8_000_000  # bytes: what a repository bears

if __name__ == "__main__":
    done = simulate("cam-imu", Path(__file__).resolve().parent.parent / "sample_bags", seed=0, force=True, progress=bar)
    size = done.bag.stat().st_size
    print(f"{done.bag.name}: {size / 1e6:.2f} MB")
    if size > LARGEST:
        raise SystemExit(f"{done.bag.name} is larger than {LARGEST / 1e6:g} MB")
