"""Train the corrector on the data of `tools.pretrain.data`, and write it where the package keeps it.

python -m tools.pretrain.train DATA FOLDER [--minutes 20] [--from WEIGHTS] [--ship] [--scenes N] [--set width=16 ...]

FOLDER keeps the state: an interrupted training goes on. Every eighth scene is held out and measured. ``--ship`` writes
the weights, as float16, and their figures into the package.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from dnrtrain import checkpoint
from dnrtrain.atomic import write_json
from dnrtrain.pretrain import pretrain
from dnrtrain.pretraining_data import SceneMaps
from dnrtrain.settings import CORRECTOR, ModelSettings
from dnrtrain.shipped import WEIGHTS, corrector

HELD_OUT = 8
"""Of so many scenes one is held out."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--minutes", type=float, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--from", dest="begin", type=Path, help="weights to go on from, e.g. the shipped ones")
    parser.add_argument("--scenes", type=int, help="train on so many of the scenes (for a curve)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=N", help="of another network (for a curve)")
    parser.add_argument("--ship", action="store_true")
    options = parser.parse_args()
    found = [SceneMaps(path.parent) for path in sorted(options.data.glob("[0-9]*/scene.json"))]
    training = [scene for scene in found if scene.scene.seed % HELD_OUT][: options.scenes]
    held_out = [scene for scene in found if scene.scene.seed % HELD_OUT == 0]
    print(f"{len(training)} scenes, {len(held_out)} held out")
    options.folder.mkdir(parents=True, exist_ok=True)
    history = options.folder / "history.jsonl"
    seconds = 60 * options.minutes
    changes = {key: int(value) for key, value in (pair.split("=") for pair in options.set)}
    model = ModelSettings.model_validate(CORRECTOR.model_dump() | changes)
    begin = corrector(options.begin) if options.begin else None
    chosen = {"model": model, "seconds": seconds, "seed": options.seed, "begin": begin}
    for record in pretrain(training, held_out, options.folder, **chosen):
        base, ours = record["psnr"]
        print(f"{record['seconds']} s, step {record['step']}: held-out {base:.2f} -> {ours:.2f} dB", flush=True)
        with history.open("a") as file:
            file.write(json.dumps(record) + "\n")
    if options.ship:
        ship(options.folder, len(training), len(held_out))


def ship(folder: Path, training: int, held_out: int) -> None:
    """Half the bytes: float16 moves a picture by less than 1/1000."""
    saved = checkpoint.load(folder / "corrector.safetensors")
    assert saved is not None
    tensors, info = saved
    checkpoint.save(WEIGHTS, {name: value.half() for name, value in tensors.items()}, info)
    last = json.loads((folder / "history.jsonl").read_text().splitlines()[-1])
    write_json(WEIGHTS.with_suffix(".json"), {"scenes": training, "held_out": held_out, **last})


if __name__ == "__main__":
    main()
