"use strict";

// The small problems with two states and one control: dynamics, the environment's steps and costs, and the policy. As
// envs.py and phased/environment.py, of one flight. `problem` are the constants that phased/page.py writes.
// It needs numbers.js and policy.js.

// x' = f(x, u), by the name of the function in envs.py.
const DYNAMICS = {
  double_integrator: ([, x2], u) => [x2, u],
  van_der_pol: ([x1, x2], u) => [x2, -x1 + 0.1 * (1 - x1 * x1) * x2 + u],
};

// The state after one step of the environment: one Runge-Kutta step, the control held.
function planeStep(problem, x, u) {
  const f = DYNAMICS[problem.dynamics];
  const { dt } = problem;
  const moved = (slope, h) => [x[0] + h * slope[0], x[1] + h * slope[1]];
  const k1 = f(x, u);
  const k2 = f(moved(k1, 0.5 * dt), u);
  const k3 = f(moved(k2, 0.5 * dt), u);
  const k4 = f(moved(k3, dt), u);
  return x.map((value, k) => value + (dt / 6) * (k1[k] + 2 * (k2[k] + k3[k]) + k4[k]));
}

// Of each step its phase, the step in it, and whether it is the phase's last one.
function timetable(problem) {
  return problem.phases.flatMap((phase, number) =>
    Array.from({ length: phase.steps }, (_, step) => ({ phase, number, step, isLast: step + 1 === phase.steps })),
  );
}

function distance(x, target) {
  return Math.hypot(x[0] - target[0], x[1] - target[1]);
}

// The cost of a step: d'Q d + R u^2, d the distance to the phase's target before it.
function stepCost(phase, x, u) {
  const state = x.reduce((total, value, k) => total + phase.Q[k] * (value - phase.target[k]) ** 2, 0);
  return state + phase.R * u * u;
}

// Fly `law(x, t)`, a control of any size, from a start. Returns x, u as it was applied, the cost, and of each phase
// whether its end hit the circle; `bonus` is what the hits are worth.
function flyPlane(problem, start, law) {
  const flight = { x: [start], u: [], cost: 0, bonus: 0, hits: [] };
  timetable(problem).forEach(({ phase, isLast }, t) => {
    const x = flight.x[t];
    const u = clamp(law(x, t), problem.u_low, problem.u_high);
    const after = planeStep(problem, x, u);
    flight.u.push(u);
    flight.x.push(after);
    flight.cost += stepCost(phase, x, u);
    if (isLast) {
      const miss = distance(after, phase.target);
      flight.cost += phase.Qf * miss * miss;
      const isHit = phase.radius === null || miss <= phase.radius;
      flight.hits.push(isHit);
      flight.bonus += isHit ? phase.bonus : 0;
    }
  });
  return flight;
}

// What the policy observes at step t, `at` in the timetable. The target that is seen moves to a new phase's over its
// first steps.
function planeObservation(problem, at, x, t) {
  const { options, phases } = problem;
  const { number, step } = at;
  const shown = x.map((value, k) => (options.hidden.includes(k) ? 0 : value));
  const tau = options.observe_phase ? t / problem.steps : 0;
  if (phases.length === 1) {
    return [...shown, tau];
  }
  const share = Math.min(step / problem.transition_steps, 1);
  const before = phases[Math.max(number - 1, 0)].target;
  const target = phases[number].target.map((value, k) => (1 - share) * before[k] + share * value);
  const phi = options.observe_phase ? number / (phases.length - 1) : 0;
  return [...shown, ...target, tau, phi];
}

// The policy as a law of `flyPlane`.
function planePolicy(policy, problem) {
  const network = new Network(policy);
  const steps = timetable(problem);
  const { observation_scale, action_scale } = network.constants;
  return (x, t) => {
    const features = planeObservation(problem, steps[t], x, t).map((value, k) => value / observation_scale.values[k]);
    const [output] = network.step(features);
    return output * action_scale.values[0] * problem.u_unit + problem.u_centre;
  };
}
