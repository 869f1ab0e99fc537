"""`benchmarks.same_training`: code that trains otherwise is found, and every seed of the results has its commit."""

import json
import subprocess
from pathlib import Path

import pytest
import torch

from benchmarks import same_training

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent


def test_one_bit_or_one_name_is_a_difference():
    ours = {"a": torch.arange(3.0), "b": torch.zeros(2)}
    other = {name: weight.clone() for name, weight in ours.items()}
    assert same_training.differing(ours, other) == 0
    other["a"][1] = torch.nextafter(torch.tensor(1.0), torch.tensor(2.0))
    assert same_training.differing(ours, other) == 1
    assert same_training.differing(ours, {"a": ours["a"], "c": ours["b"]}) == 2
    assert same_training.differing(ours, {**ours, "b": ours["b"].reshape(1, 2)}) == 1


def test_code_that_trains_otherwise_is_found(tmp_path, monkeypatch, capsys):
    """Three commits of a repository of one script: the second only renames, the third changes what is learned."""
    for change in (0.0, 1e-12):
        torch.save({"agent": {"w": torch.full((2,), 6 + change, dtype=torch.float64)}}, tmp_path / f"{change}.pt")
    script = "import pathlib, shutil, sys\n{name} = int(sys.argv[-1])\nassert {name} == 6\n"
    script += "run = pathlib.Path('runs/one'); run.mkdir(parents=True)\n"
    script += f"shutil.copy('{tmp_path}/{{change}}.pt', run / 'training_state.pt')\n"
    git = ["git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b.c"]
    subprocess.run([*git, "init", "-q"], check=True)
    for number, (name, change) in enumerate([("n", 0.0), ("updates", 0.0), ("updates", 1e-12)]):
        (tmp_path / "learn.py").write_text(script.format(name=name, change=change))
        subprocess.run([*git, "add", "learn.py"], check=True)
        subprocess.run([*git, "commit", "-q", "-m", str(number)], check=True)
    monkeypatch.setattr(same_training, "ROOT", tmp_path)
    (tmp_path / "taken").mkdir()
    assert not same_training.compare("results/one", ["learn.py"], ["HEAD~1", "HEAD~2"], 6, tmp_path / "taken")
    lines = capsys.readouterr().out.splitlines()
    assert lines == [f"results/one, 6 updates by HEAD~{k} and HEAD: 1 of 1 tensors differ" for k in (1, 2)]
    subprocess.run([*git, "reset", "-q", "--hard", "HEAD~1"], check=True)
    (tmp_path / "again").mkdir()
    assert same_training.compare("results/one", ["learn.py"], ["HEAD~1"], 6, tmp_path / "again")
    with pytest.raises(OSError, match="git has no files of 0000000"):
        same_training.checkout("0000000", tmp_path / "none")


def test_every_seed_of_the_results_has_its_commit():
    jobs = same_training.first_trainings()
    for name, commits in json.loads(same_training.COMMITS.read_text()).items():
        seeds = sorted(int(path.stem) for path in (ROOT / name / "seeds").glob("*.json"))
        assert sorted(seed for trained in commits.values() for seed in trained) == seeds, name
        assert name in jobs
