"use strict";

// The optimum from any start of a small problem: iterative LQR with bounds on the control (Tassa, Mansard and Todorov,
// 2014), the circles at the phases' ends by an augmented Lagrangian (e.g. Nocedal and Wright, chapter 17).
// It needs numbers.js and plane_physics.js.

// A and B of x_{t+1} = A x + B u + const. by central differences of fourth order, as phased/lqr.py.
function linearised(problem, x, u) {
  const h = 1 / 512;
  const slope = (move) => {
    const at = (k) => planeStep(problem, ...move(k * h));
    const [farBelow, below, above, farAbove] = [at(-2), at(-1), at(1), at(2)];
    return [0, 1].map((k) => (8 * (above[k] - below[k]) - (farAbove[k] - farBelow[k])) / (12 * h));
  };
  const byX1 = slope((change) => [[x[0] + change, x[1]], u]);
  const byX2 = slope((change) => [[x[0], x[1] + change], u]);
  const byU = slope((change) => [x, u + change]);
  return {
    A: [
      [byX1[0], byX2[0]],
      [byX1[1], byX2[1]],
    ],
    B: byU,
  };
}

// What the end of a phase adds at the state x there, with its first and second derivatives: Qf |d|^2 and, within a
// circle, the augmented Lagrangian of |d|^2 / r^2 <= 1.
function endTerms(phase, x, circle) {
  const d = [x[0] - phase.target[0], x[1] - phase.target[1]];
  const square = d[0] * d[0] + d[1] * d[1];
  const terms = { cost: phase.Qf * square, gradient: scaledPair(d, 2 * phase.Qf), curvature: diagonal(2 * phase.Qf) };
  if (!circle) {
    return terms;
  }
  const r2 = (phase.radius * SHRUNK) ** 2;
  const force = circle.multiplier + circle.weight * (square / r2 - 1);
  if (force <= 0) {
    return { ...terms, cost: terms.cost - circle.multiplier ** 2 / (2 * circle.weight) };
  }
  const normal = scaledPair(d, 2 / r2);
  return {
    cost: terms.cost + (force ** 2 - circle.multiplier ** 2) / (2 * circle.weight),
    gradient: [0, 1].map((k) => terms.gradient[k] + force * normal[k]),
    curvature: [0, 1].map((i) =>
      [0, 1].map((j) => {
        const bend = i === j ? (2 * force) / r2 : 0;
        return terms.curvature[i][j] + circle.weight * normal[i] * normal[j] + bend;
      }),
    ),
  };
}

const SHRUNK = 1 - 1e-9; // so that rounding does not put an end on the edge outside of it

function scaledPair(d, factor) {
  return [d[0] * factor, d[1] * factor];
}

function diagonal(value) {
  return [
    [value, 0],
    [0, value],
  ];
}

// The states and the cost, circles included, of controls u from a start.
function simulated(problem, steps, start, controlAt, circles) {
  const x = [start];
  const u = [];
  let cost = 0;
  steps.forEach(({ phase, number, isLast }, t) => {
    u.push(clamp(controlAt(x[t], t), problem.u_low, problem.u_high));
    x.push(planeStep(problem, x[t], u[t]));
    cost += stepCost(phase, x[t], u[t]);
    cost += isLast ? endTerms(phase, x[t + 1], circles && circles[number]).cost : 0;
  });
  return { x, u, cost };
}

// The backward pass: of each step the change k of the control and its gain K.
function feedback(problem, steps, { x, u }, circles) {
  let Vx = [0, 0];
  let Vxx = diagonal(0);
  const laws = [];
  for (let t = steps.length - 1; t >= 0; t -= 1) {
    const { phase, number, isLast } = steps[t];
    if (isLast) {
      const end = endTerms(phase, x[t + 1], circles && circles[number]);
      Vx = [0, 1].map((k) => Vx[k] + end.gradient[k]);
      Vxx = [0, 1].map((i) => [0, 1].map((j) => Vxx[i][j] + end.curvature[i][j]));
    }
    const { A, B } = linearised(problem, x[t], u[t]);
    const VA = [0, 1].map((i) => [0, 1].map((j) => Vxx[i][0] * A[0][j] + Vxx[i][1] * A[1][j]));
    const VB = [0, 1].map((i) => Vxx[i][0] * B[0] + Vxx[i][1] * B[1]);
    const Qx = [0, 1].map((i) => 2 * phase.Q[i] * (x[t][i] - phase.target[i]) + A[0][i] * Vx[0] + A[1][i] * Vx[1]);
    const Qu = 2 * phase.R * u[t] + B[0] * Vx[0] + B[1] * Vx[1];
    const Quu = 2 * phase.R + B[0] * VB[0] + B[1] * VB[1];
    const Qux = [0, 1].map((j) => B[0] * VA[0][j] + B[1] * VA[1][j]);
    const wanted = -Qu / Quu;
    const k = clamp(wanted, problem.u_low - u[t], problem.u_high - u[t]);
    const K = k === wanted ? scaledPair(Qux, -1 / Quu) : [0, 0]; // at its bound the control does not answer
    Vx = [0, 1].map((i) => Qx[i] + K[i] * (Quu * k + Qu) + Qux[i] * k);
    Vxx = [0, 1].map((i) =>
      [0, 1].map((j) => {
        const ofState = (i === j ? 2 * phase.Q[i] : 0) + A[0][i] * VA[0][j] + A[1][i] * VA[1][j];
        return ofState + Quu * K[i] * K[j] + K[i] * Qux[j] + Qux[i] * K[j];
      }),
    );
    laws[t] = { k, K };
  }
  return laws;
}

// From a guess on, until the cost falls no more.
function improved(problem, steps, start, guess, circles) {
  let best = simulated(problem, steps, start, guess, circles);
  for (let round = 0; round < 100; round += 1) {
    const laws = feedback(problem, steps, best, circles);
    let next = null;
    for (let part = 1; part > 1e-4 && !(next && next.cost < best.cost); part /= 2) {
      const law = (x, t) => {
        const { k, K } = laws[t];
        return best.u[t] + part * k + K[0] * (x[0] - best.x[t][0]) + K[1] * (x[1] - best.x[t][1]);
      };
      next = simulated(problem, steps, start, law, circles);
    }
    const gain = best.cost - next.cost;
    best = gain > 0 ? next : best;
    if (gain <= 1e-12 * Math.abs(best.cost)) {
      break;
    }
  }
  return best;
}

// The optimum that ends each phase in its circle, null where none was found.
function inCircles(problem, steps, start, guess) {
  const circles = problem.phases.map(({ radius }) => (radius === null ? null : { multiplier: 0, weight: 1 }));
  let found = guess;
  for (let round = 0; round < 30; round += 1) {
    const { u } = found;
    found = improved(problem, steps, start, (_, t) => u[t], circles);
    let worst = 0;
    for (const [t, { phase, number, isLast }] of steps.entries()) {
      const circle = circles[number];
      if (isLast && circle) {
        const violation = (distance(found.x[t + 1], phase.target) / (phase.radius * SHRUNK)) ** 2 - 1;
        worst = Math.max(worst, circle.multiplier > 0 ? Math.abs(violation) : violation);
        circle.multiplier = Math.max(circle.multiplier + circle.weight * violation, 0);
        circle.weight *= 2;
      }
    }
    if (worst < 1e-10) {
      return found;
    }
  }
  return null;
}

// The optimum as a flight of `flyPlane`. Where circles count, of those within and without them the one with the greater
// bonus less cost.
function planeOptimum(problem, start) {
  const steps = timetable(problem);
  const free = improved(problem, steps, start, () => 0, null);
  const found = [free];
  if (problem.circles_count) {
    found.push(inCircles(problem, steps, start, free) || free);
  }
  const flights = found.map(({ u }) => flyPlane(problem, start, (_, t) => u[t]));
  return flights.reduce((best, flight) => (flight.bonus - flight.cost > best.bonus - best.cost ? flight : best));
}
