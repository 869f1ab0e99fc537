"""Pictures of episodes without an optimum: each observation and action over time, and the curves of a training."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from drawing.animation import Animation, Flight
from drawing.style import POLICY, SHOWN
from drawing.time_plots import TimePlots, plot_flight, time_panels
from drawing.training import cut_outliers, plot_seeds


def training_figure(curves: list[dict], title: str) -> Figure:
    """Return, policy loss and total loss over the samples, of one run or of several seeds."""
    labels = {"charts/episodic_return": "episodic return", "eval/episodic_return": "return of the mean action"}
    labels |= {"losses/policy_loss": "policy loss", "losses/total_loss": "total loss"}
    labels = {tag: label for tag, label in labels.items() if any(tag in curve for curve in curves)}
    figure = Figure(figsize=(4 * len(labels), 3.8), layout="constrained")
    figure.suptitle(title)
    for ax, (tag, label) in zip(np.atleast_1d(figure.subplots(1, len(labels))), labels.items()):
        logged = [curve[tag] for curve in curves if tag in curve]
        plot_seeds(ax, logged, "mean" if tag.startswith("eval/") else "sampled")
        cut_outliers(ax, np.concatenate([values for _, values in logged]))
        ax.set(xlabel="environment steps", ylabel=label)
        ax.grid(alpha=0.3)
    return figure


def episodes_of(arrays: dict) -> list[Flight]:
    """The first episodes, each up to its end."""
    flights = []
    for obs, u in zip(arrays["obs"][:SHOWN], arrays["u"][:SHOWN]):
        steps = int(np.isfinite(u).all(axis=1).sum())
        flights.append(Flight.of(arrays["t"][: steps + 1], u[:steps], obs[: steps + 1], "policy"))
    return flights


def labels_of(arrays: dict) -> list[str]:
    """A name for each observation and action."""
    observations = arrays["obs"].shape[2]
    actions = arrays["u"].shape[2]
    return [*(f"observation {k}" for k in range(observations)), *(f"action {k}" for k in range(actions))]


def episodes_figure(arrays: dict, title: str) -> Figure:
    """Each observation and each action of the first episodes over time."""
    flights = episodes_of(arrays)
    figure, panels = time_panels(labels_of(arrays), row_height=2.6, rest=0.6)
    for flight in flights:
        plot_flight(panels, flight, POLICY)
    figure.suptitle(f"{title}\nthe first {len(flights)} episodes")
    return figure


def episodes_animation(arrays: dict, title: str) -> Animation:
    """The first episodes as they go."""
    sheet = TimePlots(title, labels_of(arrays), arrays["obs"].shape[2], float(arrays["t"][-1]))
    return Animation.of(sheet, [episodes_of(arrays)])
