"""From a trace that does not match to a model that does: compare, explain, add, compare again."""
import subprocess
import sys
import tempfile
from pathlib import Path

import fdi


def main(folder: Path) -> None:
    """Find what was hidden in the traces of `rig simulate --samples`, and write the model and a picture."""
    subprocess.run([sys.executable, "-m", "rig.cli.main", "simulate", "--samples", "--quiet"], cwd=folder, check=True)
    trace, repeats, held = fdi.read_trace(folder / "run.csv"), [folder / "run2.csv"], folder / "held.csv"
    print(fdi.compare(trace, repeats=repeats))

    explanation = fdi.explain(trace, repeats=repeats, holdout=held)
    print(explanation)
    better = fdi.add_effect(explanation.effects, trace, repeats=repeats, holdout=held)
    better.write_model(folder / "better.toml")

    after = fdi.compare(trace, better.model, repeats=repeats)
    after.plot().write(folder / "residual.svg")
    print(after.verdict)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as name:
            main(Path(name))
