"""The landers' figures and animation: what is drawn is what the arrays hold, and `render` follows a flight."""

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.colors import to_hex

from drawing.animation import FRAMES, SIDES
from landing import figures
from landing.animation import descent_animation
from landing.environment import limited
from landing.figures import descent_figure, flown_thrust, propellant_figure, touchdown_figure
from landing.lander import MARS
from landing.metrics import draws, flight_arrays, fly_draws

ENV_ID = "MarsLanding-v0"
SHAPE = (450, 800, 3)
FLIGHTS, KNOWN = 30, 12  # of which the optimum is known


def steer(obs, t):
    """Towards a point 2 m below the pad in 45 s, as fast as a healthy engine of nominal thrust would have to."""
    r, v = obs[:, :3] + [0.0, 0.0, 2.0], obs[:, 3:6]
    left = np.maximum(45.0 - obs[:, 6:7], 4.0)
    return 2000 * (-6 * r / left**2 - 4 * v / left + [0.0, 0.0, 3.7114]) / 24000


def flights(seed=0, n=FLIGHTS, known=KNOWN, **options):
    """The arrays of eval.npz: flights with failures, beside the same without one as if those were the optimum's."""
    z = draws(seed, n)
    flown = fly_draws(ENV_ID, lambda z: steer, z, **options)
    best = fly_draws(ENV_ID, lambda z: steer, z[:known], failure_probability=0.0)
    return flight_arrays(flown, best)


@pytest.fixture(scope="module")
def arrays():
    return flights(failure_time="random", failure_size=1.8)


def failed_rows(arrays):
    return [row for row, acts in enumerate(arrays["effectiveness"]) if np.nanmin(acts) < 1]


def flown(y):
    """The rows of a flight's states up to its end."""
    return np.array([state for state in y if not np.isnan(state).any()])


# --- paths and thrust -------------------------------------------------------------------------------------------------


def test_paths_are_those_of_the_flights(arrays):
    figure = descent_figure(arrays, "a title", MARS)
    failed = failed_rows(arrays)
    assert 5 < len(failed) < 25
    for axis, ax in enumerate(figure.axes[:2]):
        drawn = [line for line in ax.lines if line.get_color() in (figures.HEALTHY, figures.FAILED)]
        assert len(drawn) == figures.PATHS == FLIGHTS / 2
        for row, line in enumerate(drawn):
            assert np.array_equal(line.get_xydata(), arrays["y"][row][:, [axis, 2]], equal_nan=True)
            assert (line.get_color() == figures.FAILED) == (row in failed)
        best = [line.get_xydata() for line in ax.lines if line.get_color() == "tab:blue"]
        known = [flown(y)[:, [axis, 2]] for y in arrays["y_reference"]]
        assert 1 <= len(best) <= 3
        assert all(any(np.array_equal(one, other) for other in known) for one in best)
        assert [0, 0] in [line.get_xydata()[0].tolist() for line in ax.lines if line.get_marker() == "^"], "the pad"
    assert "a title" in figure.get_suptitle() and f"{figures.PATHS} flights" in figure.get_suptitle()
    assert all(ax.get_xlabel() for ax in figure.axes) and figure.axes[0].get_ylabel() == "altitude (m)"


def test_thrust_is_what_acted(arrays):
    """Newton's law on the recorded states gives the command, times the effectiveness, within the engine's limits."""
    for row in range(6):
        steps = int(np.isfinite(arrays["u"][row, :, 0]).sum())
        command, acts = arrays["u"][row, :steps], arrays["effectiveness"][row, :steps]
        expected = limited((command * acts).T, MARS.least_thrust, MARS.greatest_thrust).T
        thrust = flown_thrust(flown(arrays["y"][row]), arrays["gravity"][row], 0.2)
        assert thrust.shape == (steps, 3)
        assert thrust[:-1] == pytest.approx(expected[:-1], abs=0.1)
        assert np.array_equal(thrust[-1], thrust[-2]), "the last period is cut short by the touchdown"


# --- touchdowns -------------------------------------------------------------------------------------------------------


def test_touchdowns_are_those_of_the_flights(arrays):
    plane, errors = touchdown_figure(arrays, "a title").axes
    assert np.array_equal(plane.collections[0].get_offsets(), arrays["final_y"][:, :2])
    position = [sum(x * x for x in row[:3]) ** 0.5 for row in arrays["final_y"]]
    speed = [sum(x * x for x in row[3:6]) ** 0.5 for row in arrays["final_y"]]
    assert np.array(errors.collections[0].get_offsets()) == pytest.approx(np.c_[position, speed])
    assert errors.get_xscale() == errors.get_yscale() == "log"
    failed = failed_rows(arrays)
    for ax in (plane, errors):
        colours = [to_hex(colour) for colour in ax.collections[0].get_facecolors()]
        for row, colour in enumerate(colours):
            assert colour == to_hex(figures.FAILED if row in failed else figures.HEALTHY)
        assert "(m)" in ax.get_xlabel() and "(m" in ax.get_ylabel()


# --- propellant -------------------------------------------------------------------------------------------------------


def test_propellant_beside_the_optimums(arrays):
    (ax,) = propellant_figure(arrays, "a title").axes
    failed = [row for row in failed_rows(arrays) if row < KNOWN]
    healthy = [row for row in range(KNOWN) if row not in failed]
    fuel, best = arrays["fuel_kg"], arrays["fuel_kg_reference"]
    assert len(best) == KNOWN and failed and healthy
    names = [text.get_text() for text in ax.get_legend().texts]
    for name, rows, dots in zip(("healthy", "with a failure"), (healthy, failed), ax.collections):
        assert np.array(dots.get_offsets()) == pytest.approx(np.c_[best[rows], fuel[rows]])
        ratio = sum(fuel[row] for row in rows) / sum(best[row] for row in rows)
        assert any(text.startswith(name) and f"{ratio:.3f} x optimum" in text for text in names)
    equality = ax.lines[0]
    assert np.array_equal(equality.get_xdata(), equality.get_ydata())
    low, high = ax.get_xlim()
    assert low < min(fuel[:KNOWN].min(), best.min()) and high > max(fuel[:KNOWN].max(), best.max())
    assert ax.get_xlim() == ax.get_ylim() and f"{KNOWN} draws" in ax.get_title()


# --- the animation ----------------------------------------------------------------------------------------------------


def test_animation_shows_a_failed_flight_beside_its_optimum(arrays):
    animation = descent_animation(MARS, arrays, "a title")
    row = failed_rows(arrays)[0]
    assert row < KNOWN and len(animation.sides) == len(SIDES)
    ours, best = (side[0] for side in animation.sides)
    assert np.array_equal(ours.y, flown(arrays["y"][row])) and ours.t[-1] == arrays["final_t"][row]
    assert np.array_equal(best.y, flown(arrays["y_reference"][row]))
    strike = 0.2 * int(np.argmax(arrays["effectiveness"][row].min(axis=1) < 1))
    for time in (strike - 0.3, strike + 0.3):
        animation.sheet.show([ours.until(time)], [best.until(time)])
        assert (f"failure at {strike:.1f} s" in animation.sheet.clock.get_text()) == (time > strike)
    frames = [animation.frame(k) for k in (0, 40, FRAMES - 1)]
    assert all(frame.shape == SHAPE and frame.dtype == np.uint8 for frame in frames)
    assert (frames[0] != frames[1]).any() and (frames[1] != frames[2]).any()
    miss = np.linalg.norm(arrays["final_y"][row, :3])
    assert f"{miss:.{2 if miss < 100 else 0}f} m off" in animation.sheet.clock.get_text()


# --- render_mode="rgb_array" ------------------------------------------------------------------------------------------

HOVER = np.array([0.05, -0.05, 0.35])


def test_frames_of_the_single_environment():
    env = gym.make(ENV_ID, render_mode="rgb_array")
    env.reset(seed=1)
    frames = [env.render()]
    for _ in range(3):
        for _ in range(5):
            env.step(HOVER)
        frames.append(env.render())
    assert all(frame.shape == SHAPE and frame.dtype == np.uint8 for frame in frames)
    assert all((before != after).any() for before, after in zip(frames, frames[1:]))
    assert np.array_equal(env.render(), frames[-1]), "a look changes nothing"
    env.reset(seed=1)
    assert np.array_equal(env.render(), frames[0])
