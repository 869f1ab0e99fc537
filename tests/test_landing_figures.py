"""The landers' figures and animation: what is drawn is what the arrays hold, and `render` follows a flight."""

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.colors import to_hex

import envs
from drawing.animation import FRAMES, SIDES
from landing import figures
from landing.animation import DescentSheet, descent_animation
from landing.environment import limited
from landing.figures import descent_figure, flown_thrust, propellant_figure, touchdown_figure
from landing.lander import MARS
from landing.metrics import draws, flight_arrays, fly_draws

ENV_ID = "MarsLanding-v0"
SHAPE = (450, 800, 3)
FLIGHTS, KNOWN = 30, 12  # of which the optimum is known
EXHAUST = 210 * 9.81  # m/s


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


def texts_of(figure):
    return [text.get_text() for text in figure.legends[0].texts]


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


def test_no_more_paths_than_can_be_read(arrays, monkeypatch):
    monkeypatch.setattr(figures, "PATHS", 5)
    figure = descent_figure(arrays, "a title")
    drawn = [line for line in figure.axes[0].lines if line.get_color() in (figures.HEALTHY, figures.FAILED)]
    assert len(drawn) == 5


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


def test_thrust_over_time_beside_limits_optimum_and_failure(arrays):
    figure = descent_figure(arrays, "a title", MARS)
    panels = figure.axes[2:]
    assert len(panels) == 3
    states = []
    for ax in panels:
        row = int(ax.get_title().split(":")[0].removeprefix("flight ")) - 1
        sides = [arrays["y"], arrays["y_reference"]] if row < KNOWN else [arrays["y"]]
        assert len(ax.patches) == len(sides)
        for side, patch in zip(sides, ax.patches):
            mass = flown(side[row])[:, 6]
            burnt = -np.diff(mass)[:-1] / 0.2 * EXHAUST / 1e3  # kN
            held = patch.get_data()
            assert held.values[:-1] == pytest.approx(burnt, abs=1e-3)
            assert held.edges == pytest.approx(0.2 * np.arange(len(mass)))
        assert {4.0, 24.0} <= {line.get_ydata()[0] for line in ax.lines if line.get_linestyle() == ":"}
        strikes = [line.get_xdata()[0] for line in ax.lines if line.get_linestyle() == "--"]
        acts = arrays["effectiveness"][row].min(axis=1)
        first = [k for k, value in enumerate(acts) if value < 1][:1]
        assert strikes == pytest.approx([0.2 * k for k in first])
        assert ax.get_title().endswith(f"failure at {strikes[0]:.1f} s" if first else "healthy")
        states.append(bool(first))
    assert sorted(states) == [False, True, True], "one healthy flight and two failed ones"
    assert "the failure strikes" in texts_of(figure) and "limits of the thrust" in texts_of(figure)


def test_what_is_not_there_is_not_named():
    healthy = flights(n=4, known=2, failure_probability=0.0)
    names = texts_of(descent_figure(healthy, "a title"))
    assert "healthy" in names and not {"with a failure", "the failure strikes", "limits of the thrust"} & {*names}
    assert all("failure" not in name for name in texts_of(touchdown_figure(healthy, "a title")))
    failed = flights(n=4, known=2, failure_probability=1.0)
    figure = descent_figure(failed, "a title", MARS)
    assert "healthy" not in texts_of(figure) and "the failure strikes" not in texts_of(figure)
    assert all(ax.get_title().endswith("from the start") for ax in figure.axes[2:])


def test_one_flight_can_be_drawn():
    alone = flights(n=1, known=1, failure_probability=0.0)
    figure = descent_figure(alone, "a title", MARS)
    assert len(figure.axes) == 3 and figure.get_suptitle() == "a title"
    assert "Touchdowns of 1 flight" in touchdown_figure(alone, "a title").axes[0].get_title().splitlines()
    assert "1 draw" in propellant_figure(alone, "a title").axes[0].get_title().splitlines()


# --- touchdowns -------------------------------------------------------------------------------------------------------


def placed(arrays, position, speed):
    """Arrays whose flights end at these distances downrange, with these speeds."""
    final = np.zeros((FLIGHTS, 7))
    final[:, 0], final[:, 5] = position, -np.broadcast_to(speed, FLIGHTS)
    return arrays | {"final_y": final}


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


def test_the_published_box(arrays):
    figure = touchdown_figure(placed(arrays, 3.0, 1.0), "a title")
    plane, errors = figure.axes
    (box,) = errors.lines
    assert [5.0, 2.0] in box.get_xydata().tolist()
    assert box.get_xdata().max() == 5.0 and box.get_ydata().max() == 2.0
    assert errors.get_xlim()[1] > 5.0 and errors.get_ylim()[1] > 2.0, "its corner is in view"
    (circle,) = plane.patches
    assert circle.center == (0, 0) and circle.radius == 5.0
    assert "published box: |r| < 5 m, |v| < 2 m/s" in texts_of(figure)


@pytest.mark.parametrize("distance, sees_circle", [(0.01, False), (2.0, True), (50.0, True)])
def test_touchdowns_fill_the_view(arrays, distance, sees_circle):
    plane, _ = touchdown_figure(placed(arrays, distance, 1.0), "a title").axes
    _, half = plane.get_xlim()
    assert half > distance and plane.get_xlim() == plane.get_ylim() == (-half, half)
    assert (half > 5) == sees_circle and half < max(6, 2 * distance)
    assert ("circle of 5 m is out of view" in plane.get_title()) != sees_circle


def test_what_is_out_of_view_is_counted(arrays):
    position = np.full(1000, 0.5)
    position[:4] = 80.0
    many = {key: np.concatenate([arrays[key]] * 34)[:1000] for key in ("effectiveness", "final_y")}
    many["final_y"][:, :2] = np.c_[position, 0 * position]
    many["final_y"][:, 2] = 0.0
    many["final_y"][7, 2] = 250.0
    plane, errors = touchdown_figure(many, "a title").axes
    assert "4 are out of view" in plane.get_title() and "1 ended in the air" in plane.get_title()
    assert len(plane.collections[0].get_offsets()) == 999 and len(errors.collections[0].get_offsets()) == 1000


def test_a_touchdown_without_error_is_drawn(arrays):
    _, errors = touchdown_figure(placed(arrays, 0.0, 0.0), "a title").axes
    assert np.array(errors.collections[0].get_offsets()) == pytest.approx(1e-4)
    assert "below 0.0001" in errors.get_title()


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


def test_draws_without_an_optimum_are_left_out(arrays):
    some = {key: array.copy() for key, array in arrays.items()}
    row = failed_rows(arrays)[0]
    for missing in (0, row):  # of the flights whose thrust is shown, and of the one that moves
        some["fuel_kg_reference"][missing] = np.nan
        some["y_reference"][missing] = np.nan
    (ax,) = propellant_figure(some, "a title").axes
    shown = np.concatenate([np.array(dots.get_offsets()) for dots in ax.collections])
    known = [k for k in range(KNOWN) if k not in (0, row)]
    assert sorted(shown[:, 1]) == pytest.approx(sorted(arrays["fuel_kg"][known]))
    assert f"{len(known)} draws" in ax.get_title()
    panels = {ax.get_title().split(":")[0]: ax for ax in descent_figure(some, "a title").axes[2:]}
    assert len(panels["flight 1"].patches) == len(panels[f"flight {row + 1}"].patches) == 1
    assert len(descent_animation(MARS, some, "a title").sides) == 1


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


def test_animation_of_healthy_flights_and_of_unknown_optima():
    healthy = flights(n=3, known=1, failure_probability=0.0)
    animation = descent_animation(MARS, healthy, "a title")
    assert len(animation.sides) == 2 and "failure" not in animation.sheet.clock.get_text()
    del healthy["y_reference"]
    animation = descent_animation(MARS, healthy, "a title")
    (ours,) = animation.sides
    assert np.array_equal(ours[0].y, flown(healthy["y"][0])) and animation.frame(60).shape == SHAPE


@pytest.mark.slow
def test_the_gif_is_small(arrays, tmp_path):
    path = tmp_path / "animation.gif"
    descent_animation(MARS, arrays, "MarsLanding-v0: 99.95% of 10000 flights landed").write(path)
    assert 20_000 < path.stat().st_size < 250_000


@pytest.mark.parametrize("thrust", [(0.0, 0.0, 20e3), (12e3, -9e3, 6e3), (-8e3, 0.0, 1e3), (0.0, 12e3, -9e3)])
def test_the_flame_points_away_from_the_thrust(thrust):
    sheet = DescentSheet(MARS, "a title")
    y = np.array([[900.0, 200.0, 1500.0, 0.0, 0.0, -50.0, 2000.0], [900.0, 200.0, 1490.0, 0.0, 0.0, -50.0, 1999.0]])
    sheet.frame(np.array([0.0, 0.2]), np.array([thrust]), y)
    for axis, ax, flame, body in zip((0, 1), sheet.views, sheet.flames, sheet.bodies):
        head, seen = y[-1, [axis, 2]], np.array(thrust)[[axis, 2]]
        tip = flame.get_xy()[1] - head
        size = np.linalg.norm(seen)
        assert tip / np.linalg.norm(tip) == pytest.approx(-seen / size, abs=1e-9)
        assert np.linalg.norm(tip) == pytest.approx(0.2 * np.ptp(ax.get_ylim()) * size / 24e3)
        assert ((body.get_xy() - head) @ seen > -1e-6).all(), "the body is ahead of it"
        x, z = ax.transData.transform([[0, 0], [1, 1]]).T
        assert np.ptp(x) == pytest.approx(np.ptp(z)), "one scale: the direction is true"
        assert flame.get_visible()


def test_everything_is_in_view_and_the_readings_are_those_of_the_state():
    sheet = DescentSheet(MARS, "a title")
    t = np.array([0.0, 50.0, 100.0])
    y = np.array([[0.0, 0.0, 2350.0, 0.0, 0.0, -80.0, 2000.0], [3000.0, 0.0, 3100.0, 0.0, 0.0, 0.0, 1900.0]])
    y = np.vstack([y, [-4000.0, 2500.0, 700.0, 3.0, 0.0, -4.0, 1880.0]])
    sheet.frame(t, np.full((2, 3), 5e3), y)
    for axis, ax in enumerate(sheet.views):
        for values, (low, high) in ((y[:, axis], ax.get_xlim()), (y[:, 2], ax.get_ylim())):
            assert low < min(values.min(), 0) and high > values.max()
    assert sheet.thrust.get_xlim()[1] >= 100
    assert sheet.readings[0].get_text().split() == ["700", "5.0", "120"]
    assert sheet.clock.get_text() == "t = 100 s"


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


def test_the_frame_after_touchdown():
    env = gym.make(ENV_ID, render_mode="rgb_array", failure_probability=0.0)
    env.reset(seed=1)
    ended = False
    while not ended:
        _, _, ended, _, _ = env.step(np.array([0.0, 0.0, 0.2]))
    assert env.render().shape == SHAPE
    sheet = env.unwrapped.batch._sheet
    assert f"down at {env.unwrapped.batch.time[0]:.1f} s" in sheet.clock.get_text()
    assert not any(flame.get_visible() for flame in sheet.flames)


@pytest.mark.parametrize("env_id", [ENV_ID, "PoweredDescent-v0"])
def test_frames_of_the_batch_are_those_of_single_environments(env_id):
    batch = gym.make_vec(env_id, num_envs=2, render_mode="rgb_array")
    single = gym.make(env_id, render_mode="rgb_array")
    assert env_id in envs.LANDERS
    batch.reset(options={"draw": draws(3, 2)})
    single.reset(options={"draw": draws(3, 2)[1]})
    for _ in range(6):
        batch.step(np.stack([-HOVER, HOVER]))
        single.step(HOVER)
    frames = batch.render()
    assert len(frames) == 2 and (frames[0] != frames[1]).any()
    assert np.array_equal(frames[1], single.render())
