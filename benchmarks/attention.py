"""What the attention heads look at: the weights over the window, head by head, along one flight of a trained policy.

    python -m benchmarks.attention results/rocket_dispersed results/memory/attention_rocket.png
    python -m benchmarks.attention results/vdp_waypoints results/memory/attention_waypoints.png

Flies the mean action once (a rocket trained on dispersions: the first draw of seed 0, else the first start), draws a
panel for each head, and prints how far back each looks: the mean distance under its weights, what uniform weights would
give, and its largest weight on an earlier step.
"""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from matplotlib.figure import Figure

from benchmarks.policies import load
from common.command_line import OneLineParser
from common.flying import fly_until_ended
from common.tasks import task_of
from drawing.style import save_figures


def observations(agent, args, options):
    """One flight of the mean action: observations (T, obs), their times (T,) in s, and the begins of phases in s."""
    environment = gym.make_vec(args.env_id, num_envs=1, **options)
    obs, _ = environment.reset(options=task_of(args.env_id).reset_options(0, 1, **options))
    policy = agent.make_policy(environment.episode_steps)
    seen = []
    phases = [environment.phase[0]]

    def record(step):
        seen.append(step.obs[0])
        phases.append(environment.phase[0])

    fly_until_ended(environment, policy, obs, record)
    t = environment.dt * np.arange(len(seen))
    return np.array(seen), t, t[1:][np.diff(phases[:-1]) > 0]


@torch.no_grad()
def weights(agent, obs):
    """The attention weights (blocks, H, T, L + 1) of a flight's steps, by distance: 0 is the step itself.

    Before the start lies the evaluation's memory of zeros, whose weights count.
    """
    inputs, L = [], agent.memory_length
    hooks = [block.attention.register_forward_pre_hook(lambda _, given: inputs.append(given)) for block in agent.blocks]
    agent.encode(torch.as_tensor(obs, dtype=agent.actor_logstd.dtype)[None], agent.new_memory(1, noise=0.0))
    for hook in hooks:
        hook.remove()
    found = []
    for block, (x, memory) in zip(agent.blocks, inputs):
        attention = block.attention
        (keys, _), projections, R = attention.start_cache(torch.cat([memory, x], dim=1), 0)  # (1, H, L + T, dk)
        q, _ = attention.project(x[0], projections)  # (T, H, 1, dk)
        windows = keys[0].unfold(1, L + 1, 1).permute(1, 0, 3, 2)  # (T, H, L + 1, dk)
        scores = q @ (windows + R).transpose(-1, -2)  # (T, H, 1, L + 1), distance L first
        found.append(scores.softmax(dim=-1).squeeze(2).transpose(0, 1).flip(-1))
    return torch.stack(found).numpy()


def attention_figure(found, t, events, title):
    """A panel for each block and head: how far back (s) over the time of the flight (s), the weight as colour."""
    blocks, heads, _, window = found.shape
    dt = t[1] - t[0]
    figure = Figure(figsize=(3.2 * heads, 2.6 * blocks + 0.8), layout="constrained")
    panels = figure.subplots(blocks, heads, sharex=True, sharey=True, squeeze=False)
    for b, row in enumerate(panels):
        for h, ax in enumerate(row):
            shown = np.sqrt(found[b, h].T)  # a root, so that small weights are seen
            image = ax.pcolormesh(t, dt * np.arange(window), shown, vmin=0, vmax=1, cmap="magma", shading="nearest")
            for event in events:
                ax.axvline(event, color="tab:cyan", linewidth=0.8)
            ax.set_title(f"block {b + 1}, head {h + 1}", fontsize=9)
    for ax in panels[-1]:
        ax.set_xlabel("time of flight (s)")
    for ax in panels[:, 0]:
        ax.set_ylabel("looks back (s)")
    figure.colorbar(image, ax=panels, label="square root of the weight", shrink=0.8)
    figure.suptitle(title)
    return figure


def lines(found, t):
    """The printed table: each head's mean distance (s) under its weights, and its largest weight on an earlier step."""
    dt, window = t[1] - t[0], found.shape[-1]
    back = dt * found @ np.arange(window)  # (blocks, H, T)
    rows = [f"mean distance looked back, s (uniform weights: {dt * (window - 1) / 2:.2f})"]
    for b, h in np.ndindex(found.shape[:2]):
        weight, step, other = heaviest(found[b, h])
        at = f"{weight:.2f} (at {dt * step:.1f} s on that of {dt * other:.1f} s)"
        rows.append(f"  block {b + 1}, head {h + 1}: {back[b, h].mean():.2f}; at most on another step {at}")
    return rows


def heaviest(found):
    """A head's largest weight (T, L + 1) on an earlier step of the flight, the step that looks, and the earlier one."""
    steps, backs = np.indices(found.shape)
    earlier = np.where((backs > 0) & (backs <= steps), found, 0.0)
    step, back = np.unravel_index(earlier.argmax(), found.shape)
    return earlier.max(), step, step - back


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="results/<name> or runs/...")
    parser.add_argument("figure", type=Path, help="the .png to write")
    options = parser.parse_args()
    try:
        agent, args, env_options = load(options.folder / "agent.safetensors")
        if not args.num_blocks:
            raise ValueError(f"{options.folder}: num_blocks is 0; a plain MLP has no attention")
        obs, t, events = observations(agent, args, env_options)
        found = weights(agent, obs)
        print("\n".join(lines(found, t)))
        title = f"{args.env_id}: attention along one flight (lines: a new phase)"
        figure = attention_figure(found, t, events, title)
        save_figures(options.figure.parent, {options.figure.name: figure})
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
