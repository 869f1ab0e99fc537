"""The problems: dynamics and tables of the small ones, and every environment id.

Importing this module registers the problems of the paper's section "Numerical Simulations":

    DoubleIntegrator-v0  DoubleIntegratorWaypoints-v0  VanDerPol-v0  VanDerPolWaypoints-v0  RocketAscent-v0

We add the ascent with free final time, two landings of other papers, and the files of `problems/` and `vehicles/`:

    RocketAscentCutoff-v0  MarsLanding-v0  PoweredDescent-v0

`gymnasium.make(id)` gives one environment. `gymnasium.make_vec(id, num_envs=N)` gives N environments, stepped together
in float64 NumPy without a Python loop over environments. The environments are `phased/environment.py` for the small
problems, `rocket/environment.py` and `landing/environment.py`. Their base is `common/batch.py`. Users of environments
can import all that they need from here.

- To add a problem like the small ones, write its dynamics and table in a file of `problems/` that calls
  `register_problem`.
- To add a rocket or a lander, write a file of `vehicles/` that calls `register_rocket` or `register_lander`.
- To add a family, write a folder, and add one line `add_family` at the end of this file.

Reading order: names for users, dynamics, tables, registration.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from common.errors import BadInput
from common.registration import REMARKS, RegisteredIds
from common.tasks import add_family
from landing.lander import LANDERS, MARS, POWERED_DESCENT, Lander, register_lander
from phased.problem import PROBLEMS, Phase, Problem, register_problem, uniform
from rocket.missions import ANY_ORBIT, PAPER_MISSION, ROCKETS, Mission, register_rocket
from rocket.targets import Targets
from rocket.vehicle import ROCKET, Burn, Engine, Rocket, delta_v, launch_raan

__all__ = [  # what users import from here; the rest of it is in `ON_DEMAND`
    "LANDERS", "MARS", "PAPER_MISSION", "POWERED_DESCENT", "PROBLEMS", "ROCKET", "ROCKETS", "BadInput", "Burn",
    "Engine", "Lander", "Mission", "Phase", "Problem", "Rocket", "Targets", "delta_v", "launch_raan", "own_ids",
    "register_lander", "register_problem", "register_rocket", "uniform",
]  # fmt: skip

ON_DEMAND = {  # {name: the module that holds it}, which is imported when the name is asked for
    "BatchedEnv": "common.batch",
    "SingleEnv": "common.batch",
    "rk4": "common.integration",
    "LanderEnv": "landing.environment",
    "LanderVectorEnv": "landing.environment",
    "fly_lander": "landing.environment",
    "make_lander": "landing.environment",
    "make_lander_vector": "landing.environment",
    "PhasedEnv": "phased.environment",
    "PhasedVectorEnv": "phased.environment",
    "fly": "phased.environment",
    "make_phased": "phased.environment",
    "make_phased_vector": "phased.environment",
    "DISPERSION": "rocket.dispersion",
    "Dispersion": "rocket.dispersion",
    "draw_bounds": "rocket.dispersion",
    "draw_names": "rocket.dispersion",
    "draw_vehicles": "rocket.dispersion",
    "ascent_dynamics": "rocket.dynamics",
    "RocketEnv": "rocket.environment",
    "RocketVectorEnv": "rocket.environment",
    "flown_mission": "rocket.environment",
    "fly_rocket": "rocket.environment",
    "make_rocket": "rocket.environment",
    "make_rocket_vector": "rocket.environment",
    "local_frame": "rocket.orbits",
    "orbit_vectors": "rocket.orbits",
    "orbital_elements": "rocket.orbits",
    "specific_energy": "rocket.orbits",
    "target_axes": "rocket.orbits",
    "target_orbit": "rocket.orbits",
    "terminal_error": "rocket.orbits",
}
__all__ += [*ON_DEMAND]


def __getattr__(name: str):
    """A name of `ON_DEMAND`, as if it had been imported at the top. Python calls this for a name it does not find."""
    if name not in ON_DEMAND:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(ON_DEMAND[name]), name)


# ---------------------------------------------------------------------------------------------------------------------
# Dynamics. x is a tuple of components, each a NumPy array over environments or a CasADi symbol
# ---------------------------------------------------------------------------------------------------------------------


def double_integrator(x, u):
    """Position and velocity driven by an acceleration: x1' = x2, x2' = u (Eq. (13))."""
    _, x2 = x
    return x2, u


def van_der_pol(x, u, epsilon=0.1):
    """Van der Pol oscillator: x1' = x2, x2' = -x1 + epsilon (1 - x1^2) x2 + u (Eq. (16))."""
    x1, x2 = x
    return x2, -x1 + epsilon * (1 - x1 * x1) * x2 + u


# ---------------------------------------------------------------------------------------------------------------------
# Tables (the paper's tables "Double Integrator / Van der Pol Oscillator Simulation Parameters")
# ---------------------------------------------------------------------------------------------------------------------


DOUBLE_INTEGRATOR = Problem(
    env_id="DoubleIntegrator-v0",
    f=double_integrator,
    u_max=4.0,
    phases=(Phase(steps=50, target=(0.0, 0.0), radius=0.05, R=0.1, Qf=20.0, bonus=20.0),),
    x_max=(57.0, 22.0),  # |x2| <= 1 + u T, |x1| <= 1 + T + u T^2 / 2, and room for rounding
    single_optimum=True,
    u_scale=1.0,  # an action is u itself
)

DOUBLE_INTEGRATOR_WAYPOINTS = Problem(
    env_id="DoubleIntegratorWaypoints-v0",
    f=double_integrator,
    u_max=3.0,
    phases=(
        Phase(steps=50, target=(0.0, 0.0), radius=0.02, R=0.1, Qf=20.0, bonus=20.0),
        Phase(steps=50, target=(0.5, 0.5), radius=0.02, R=0.1, Qf=30.0, bonus=20.0),
    ),
    x_max=(162.0, 32.0),
    single_optimum=True,
    u_scale=1.0,  # an action is u itself
)

VAN_DER_POL = Problem(
    env_id="VanDerPol-v0",
    f=van_der_pol,
    u_max=1.5,
    phases=(Phase(steps=70, target=(0.0, 0.0), radius=0.05, R=1.0, Qf=20.0, bonus=20.0),),
    x_max=(19.0, 19.0),  # |x|' <= epsilon |x| + u, so |x(T)| <= (sqrt 2 + u / epsilon) e^(epsilon T) - u / epsilon
    single_optimum=True,
    u_scale=1.0,  # an action is u itself
)

VAN_DER_POL_WAYPOINTS = Problem(
    env_id="VanDerPolWaypoints-v0",
    f=van_der_pol,
    u_max=1.5,
    phases=(
        Phase(steps=50, target=(0.0, 0.0), radius=0.05, R=0.005, Qf=25.0, bonus=25.0),
        Phase(steps=40, target=(0.2, 0.2), radius=0.05, R=0.005, Qf=30.0, bonus=30.0),
        Phase(steps=50, target=(0.5, 0.5), radius=0.05, R=0.01, Qf=40.0, bonus=40.0),
    ),
    x_max=(52.0, 52.0),
    single_optimum=True,
    u_scale=1.0,  # an action is u itself
)


# ---------------------------------------------------------------------------------------------------------------------
# Registration (no max_episode_steps: the horizon is the problem's, and by our reading its end is a true end)
# ---------------------------------------------------------------------------------------------------------------------

BUILT_IN = (DOUBLE_INTEGRATOR, DOUBLE_INTEGRATOR_WAYPOINTS, VAN_DER_POL, VAN_DER_POL_WAYPOINTS)
for _problem in BUILT_IN:
    register_problem(_problem)


OF_ANOTHER = ".* was another rocket's id"  # the warning of `register_rocket`
FILE_OF_ROCKET: dict[str, str] = {}  # the file that registered it, by environment id


def import_files_of(folder: str):
    """Run every file of a folder of tables. A file that fails is left out, with a line that says why.

    The warnings of a file about its rockets are kept, and said when one of them is flown.
    """
    for path in sorted(Path(__file__).parent.glob(f"{folder}/*.py")):
        known = set(ROCKETS)
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.filterwarnings("error", message=OF_ANOTHER)
                import_module(f"{folder}.{path.stem}")
            new = ROCKETS.keys() - known
            FILE_OF_ROCKET.update(dict.fromkeys(new, f"{folder}/{path.name}"))
            keep_remarks(f"{folder}/{path.name}", new, caught)
        except BadInput as error:
            print(f"{folder}/{path.name} is left out: {error}", file=sys.stderr)
        except UserWarning as error:
            env_id = str(error).split()[0]
            other = FILE_OF_ROCKET.get(env_id, "envs.py")
            print(
                f"{folder}/{path.name} is left out: env_id is {env_id!r}, which {other} has already; it must be new",
                file=sys.stderr,
            )
        except (Exception, SystemExit) as error:  # a bad file must not stop the other files
            why = f"{type(error).__name__}: {error}"
            print(f"{folder}/{path.name} is left out: {why}", file=sys.stderr)


def keep_remarks(file: str, rockets, caught: list):
    """Keep the warnings of a file until one of its rockets is flown. Without a rocket they are said at once."""
    lines = [f"{file}: {warning.message}" for warning in caught]
    for env_id in rockets:
        REMARKS[env_id] = lines
    if not rockets:
        for line in lines:
            print(line, file=sys.stderr)


register_rocket("RocketAscent-v0", **vars(PAPER_MISSION))
register_rocket("RocketAscentCutoff-v0", **vars(replace(PAPER_MISSION, cutoff=True, floor_km=110.0)))
register_rocket("RocketAscentAnyOrbit-v0", **vars(ANY_ORBIT))
register_lander("MarsLanding-v0", MARS)
register_lander("PoweredDescent-v0", POWERED_DESCENT)
import_files_of("problems")
import_files_of("vehicles")
TABLES_OF_FILES = dict(PROBLEMS)  # of this file and of problems/: what every process knows that imports this module
WITHOUT_OPTIMUM = RegisteredIds(PROBLEMS, ROCKETS, LANDERS)
add_family(PROBLEMS, "baselines:problem_task")
add_family(ROCKETS, "rocket.task:RocketTask.of")
add_family(LANDERS, "landing.task:LanderTask.of")
add_family(WITHOUT_OPTIMUM, "batched.task:BatchedTask")


def own_ids() -> list[str]:
    """The ids that are not built in: tables of `problems/`, and registered environments derived from `BatchedEnv`."""
    built_in = {problem.env_id for problem in BUILT_IN}
    return [env_id for env_id in (*PROBLEMS, *WITHOUT_OPTIMUM) if env_id not in built_in]
