"""Several processes (torchrun, on one machine or several) against one: gradients, weights, a rank that dies, resume."""

import copy
import os
import signal
import socket
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.distributed as dist
from conftest import UnevenEnvs, update
from helpers import NETWORK, SMALL, parse
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import ppo_gtrxl_di as script
import runs
from benchmarks.robustness import PROCESSES
from common.schedule import Schedule

pytestmark = pytest.mark.slow

LENGTHS = [6, 2, 5, 1, 6, 3, 4, 6]  # the first half flies 14 steps, the second 19: means over ranks would be wrong
FLAGS = [*NETWORK, "--num-envs=5", "--num-minibatches=2", "--update-epochs=2", "--eval-starts=10", "--eval-every=0"]


def batch_of(envs, agent):
    torch.manual_seed(1)
    return script.rollout(agent, envs, {}, 1.0, 0.1)


def share(batch, episodes):
    """The batch of some of its episodes; the memory's episodes are its second dimension, too."""
    return script.Batch(*(getattr(batch, name)[:, episodes].clone() for name in list(vars(batch))[:7]))


def learn(rank, world, folder, settings):
    """One update of this rank's half of the episodes; saves what came of it. The ranks meet in the folder."""
    torch.set_num_threads(1)
    if world > 1:
        dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=world)
    settings = {"learning_rate": 1e-3, **settings}
    args = script.Args(**SMALL, num_minibatches=2, update_epochs=2, **settings)
    envs = UnevenEnvs(LENGTHS)
    envs.num_envs, envs.flights_per_start = len(LENGTHS) // world, round(args.flights_per_start.at(0.0))
    torch.manual_seed(0)
    agent = script.Agent(args, envs)
    batch = torch.load(f"{folder}/batch.pt", weights_only=False)
    half = len(LENGTHS) // 2
    # minibatch k of one process is the union of the ranks' minibatches k
    order = torch.arange(half) if world > 1 else torch.tensor([0, 1, 4, 5, 2, 3, 6, 7])
    torch.randperm = lambda n, device=None: order
    batch = share(batch, slice(rank * half, (rank + 1) * half)) if world > 1 else batch
    average = AveragedModel(agent, multi_avg_fn=get_ema_multi_avg_fn(0.9))
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3, eps=1e-5)
    gradients, step, loss, reduce, exchanges = [], optimizer.step, script.ppo_loss, dist.all_reduce, []

    def record():
        gradients.append({name: p.grad.clone() for name, p in agent.named_parameters() if p.grad is not None})
        step()

    def count(tensor):
        if exchanges:  # the first minibatch has begun, what came before is the advantages'
            exchanges[-1] += 1
        reduce(tensor)

    optimizer.step, dist.all_reduce = record, count
    script.ppo_loss = lambda *inputs: [exchanges.append(0), loss(*inputs)][1]
    losses = update(script, args, (agent, average, optimizer), envs, batch)
    assert world == 1 or 1 <= max(exchanges[:-1]) <= 3, exchanges  # the last is counted with what is logged
    saved = {"gradients": gradients, "weights": agent.state_dict(), "losses": losses, "advantages": batch.advantages}
    torch.save({**saved, "alive": batch.alive, "targets": batch.targets}, f"{folder}/{world}_{rank}.pt")


@pytest.mark.parametrize(
    "settings",
    [{}, {"flights_per_start": 2, "gamma": 1.0}, {"target_kl": 1e-3, "learning_rate": 0.01}],
    ids=["plain", "groups", "kl_stop"],
)
def test_two_processes_learn_what_one_does(tmp_path, settings):
    """Gradients, weights, losses, advantages."""
    torch.manual_seed(0)
    args, envs = script.Args(**SMALL), UnevenEnvs(LENGTHS)
    torch.save(batch_of(envs, script.Agent(args, envs))[0], tmp_path / "batch.pt")
    ranks = [(rank, world, str(tmp_path), settings) for rank, world in ((0, 1), (0, 2), (1, 2))]
    processes = [PROCESSES.Process(target=learn, args=rank) for rank in ranks]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
    assert [process.exitcode for process in processes] == [0, 0, 0]
    one, first, second = (torch.load(tmp_path / f"{name}.pt") for name in ("1_0", "2_0", "2_1"))
    assert len(one["gradients"]) == len(first["gradients"]) == len(second["gradients"])
    assert len(one["gradients"]) == 4 if "target_kl" not in settings else 1 <= len(one["gradients"]) < 4
    for gradient, *others in zip(one["gradients"], first["gradients"], second["gradients"]):
        for other in others:
            torch.testing.assert_close(other, gradient, rtol=0, atol=1e-6)
    assert max(gradient.abs().max() for gradient in one["gradients"][0].values()) > 1e-3
    for other in (first, second):
        torch.testing.assert_close(other["weights"], one["weights"], rtol=0, atol=1e-5)
        assert other["losses"] == pytest.approx(one["losses"], rel=1e-4, abs=1e-6)
    for name in ("advantages", "targets"):
        both = torch.cat([first[name], second[name]], dim=1)
        torch.testing.assert_close(both[one["alive"] > 0], one[name][one["alive"] > 0], rtol=1e-5, atol=1e-6)


# --- torchrun ---------------------------------------------------------------------------------------------------------


def torchrun(folder, *words):
    """Start torchrun in this folder."""
    command = [sys.executable, "-m", "torch.distributed.run", *map(str, words)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, cwd=folder, env=environment, **streams)


def two_processes(folder, *argv):
    """Start the script in two processes of one machine."""
    return torchrun(folder, "--standalone", "--nproc_per_node=2", script.__file__, *argv)


def ended_well(process):
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The training state of a run of two processes in one go."""
    folder = tmp_path_factory.mktemp("whole")
    ended_well(two_processes(folder, *FLAGS, "--total-updates=20"))
    return state_in(folder)


# --- several machines: torchrun's agents that meet over TCP, here on the loopback -------------------------------------


def free_port():
    with socket.socket() as asked:
        asked.bind(("127.0.0.1", 0))
        return asked.getsockname()[1]


def two_machines(folders, *argv, rendezvous):
    """Start torchrun in each folder, as on a machine of its own with one process; returns both agents."""
    port, agents = free_port(), []
    for rank, folder in enumerate(folders):
        if rendezvous == "static":
            meet = [f"--node-rank={rank}", "--master-addr=127.0.0.1", f"--master-port={port}"]
        else:
            meet = ["--rdzv-backend=c10d", f"--rdzv-endpoint=127.0.0.1:{port}", "--rdzv-id=test"]
        agents.append(torchrun(folder, "--nnodes=2", "--nproc_per_node=1", *meet, script.__file__, *argv))
    return agents


def ends_of(agents, timeout=300):
    """Exit statuses and outputs of both agents."""
    outputs = [agent.communicate(timeout=timeout)[0] for agent in agents]
    return [agent.returncode for agent in agents], outputs


def folders_of(tmp_path, *names):
    folders = [tmp_path / name for name in names]
    for folder in folders:
        folder.mkdir()
    return folders


def state_in(folder):
    """The training state of the one run below a folder."""
    (run,) = (folder / "runs").iterdir()
    assert (run / "eval.json").exists()
    return torch.load(run / "training_state.pt", weights_only=True)


def test_two_machines_train_as_two_processes_of_one(tmp_path, whole):
    """The script's run, to the last bit; its folder is on one machine alone."""
    folders = folders_of(tmp_path, "first", "second")
    statuses, outputs = ends_of(two_machines(folders, *FLAGS, "--total-updates=20", rendezvous="c10d"))
    assert statuses == [0, 0], outputs
    (folder,) = [folder for folder in folders if list(folder.iterdir())]  # the agents agree on who is first
    assert_same_weights(state_in(folder), whole)


def assert_same_weights(one, other):
    for part in ("agent", "average"):
        torch.testing.assert_close(one[part], other[part], rtol=0, atol=0)


def test_a_machine_that_dies_ends_the_other(tmp_path):
    """The second one is killed, agent and worker; the first one fails within 60 s and keeps its last checkpoint."""
    folders = folders_of(tmp_path, "first", "second")
    agents = two_machines(folders, *FLAGS, "--total-updates=100000", rendezvous="static")
    while not list(folders[0].glob("runs/*/agent.safetensors")):
        assert all(agent.poll() is None for agent in agents), ends_of(agents)
        time.sleep(0.05)
    for pid in (*children(agents[1].pid), agents[1].pid):
        os.kill(pid, signal.SIGKILL)
    killed = time.time()
    statuses, outputs = ends_of(agents, timeout=60)
    assert all(statuses) and time.time() - killed < 60, outputs
    (run,) = folders[0].glob("runs/*")
    assert (run / "training_state.pt").exists() and not (run / "eval.json").exists()


# --- torchrun's processes of one machine ------------------------------------------------------------------------------


def children(pid):
    """The processes that a process started."""
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True)
    return [int(child) for child in found.stdout.split()]


def test_torchrun_death_and_resume(tmp_path, whole):
    """A worker that is killed ends both within 60 s; resumed, the run has the bits of the uninterrupted one."""
    process = two_processes(tmp_path, *FLAGS, "--total-updates=20")
    while process.poll() is None and not list(tmp_path.glob("runs/*/agent.safetensors")):
        time.sleep(0.02)
    killed = time.time()
    os.kill(children(process.pid)[-1], signal.SIGKILL)
    output, _ = process.communicate(timeout=60)
    assert process.returncode != 0 and time.time() - killed < 60, output
    (run,) = tmp_path.glob("runs/*")
    assert not (run / "eval.json").exists(), "it ended before it was killed"
    ended_well(two_processes(tmp_path, f"--resume={run}"))
    resumed = state_in(tmp_path)
    assert whole["progress"]["global_step"] == resumed["progress"]["global_step"] == 20 * 5 * 50
    assert_same_weights(resumed, whole)
    assert len(whole["rng"]) == 2 and not torch.equal(whole["rng"][0]["torch"], whole["rng"][1]["torch"])
    with pytest.raises(SystemExit, match="it was trained by 2 processes"):
        script.main([f"--resume={run}"])


def test_a_rank_without_torchrun_is_one_line(monkeypatch):
    """As some batch systems set it."""
    for name in ("WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("RANK", "0")
    with pytest.raises(SystemExit, match="^error: RANK is 0, but WORLD_SIZE is not set"):
        runs.join_processes(cuda=False)


def test_processes_draw_other_noise(monkeypatch):
    """With the weights of one seed: the first process goes on with its own generator, the second takes another seed."""
    drawn = []
    for rank in (0, 1):
        monkeypatch.setattr(runs, "rank_and_world_size", lambda rank=rank: (rank, 2))
        torch.manual_seed(1)
        runs.Run(script.Args(seed=1), None, None, None, None, SimpleNamespace(episode_steps=50), {}, None)
        drawn.append(torch.randn(5))
    assert not (drawn[0] == drawn[1]).any()


def test_processes_fly_starts_of_their_own(monkeypatch):
    starts = []
    for rank in (0, 1):
        monkeypatch.setattr(runs, "rank_and_world_size", lambda rank=rank: (rank, 2))
        envs = runs.make_envs(script.Args(num_envs=5), {})
        starts += envs.reset()[0][:, :2].tolist()
    assert len(starts) == 5 and len({x for start in starts for x in start}) == 10


def test_more_processes_than_environments(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "4")
    with pytest.raises(SystemExit, match="--num-envs 3: must be at least the number of processes, 4"):
        parse(script, "--num-envs=3")
    with pytest.raises(SystemExit, match=r"--num-minibatches 3: must be at most --num-envs 8 / 4 processes"):
        parse(script, "--num-envs=8", "--num-minibatches=3")
    assert parse(script, "--num-envs=8").num_minibatches == 2


def test_every_process_flies_whole_groups(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(SystemExit, match="--flights-per-start 4: must divide --num-envs 12 / 2 processes"):
        parse(script, "--num-envs=12", "--flights-per-start=4")
    assert parse(script, "--num-envs=12", "--flights-per-start=3").flights_per_start == Schedule(3)


def test_shares_of_different_sizes(monkeypatch):
    """Without groups three and two environments are as good as any."""
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert parse(script, "--num-envs=5", "--recipe=paper").flights_per_start == Schedule(1)
    assert str(parse(script, "--num-envs=5").flights_per_start) == "0:1 0.4:1 0.4:1"  # lowered from 8


def test_moments_are_those_of_the_living(monkeypatch):
    x, alive = np.random.default_rng(0).normal(size=(2, 4, 6))
    alive = (alive > 0).astype(float)
    mean, variance = script.moments(torch.tensor(x), torch.tensor(alive), (0, 1))
    living = copy.copy(x[alive > 0])
    assert (mean.item(), variance.item()) == pytest.approx((living.mean(), living.var()))
