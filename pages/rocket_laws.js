"use strict";

// What steers the rocket: the policy, the optimum's directions, and LQR about the optimum; and what is read of a
// flight. As ppo_gtrxl_rocket.py and rocket/guidance.py. It needs numbers.js, policy.js and rocket_physics.js.

// ---------------------------------------------------------------------------------------------------------------------
// The policy: what it observes, what its encoder sees, and its direction
// ---------------------------------------------------------------------------------------------------------------------

// The environment's observation: r, v, the flight computer's mass, the share of the time that is left, the phase; then
// the draw's scores, where the policy was shown them. `options` are those of its training.
function observationOf(ascent, options, changes) {
  const { rocket } = ascent;
  const left = 1 - ascent.time / rocket.end_time;
  const phase = ascent.burn / Math.max(ascent.lastBurn, 1);
  const mass = options.observe_mass ? ascent.y[6] : computedMass(ascent);
  const clock = options.observe_phase ? [left, phase] : [0, 0];
  const scores = rocket.scores.map(({ of, sigma }) => (of && sigma ? changes[of] / sigma : 0));
  const draw = options.observe_draw ? scores : [];
  const target = rocket.targets ? toldTarget(rocket) : [];
  return [...ascent.y.slice(0, 6), mass, ...clock, ...target, ...draw];
}

// What a flight shows of its own target: unit vectors to the perigee and normal to the plane, momentum, eccentricity.
function toldTarget({ axes, h_target, e }) {
  return [...axes[0], ...axes[2], norm(h_target), e];
}

const TOLD = 8; // such numbers

// `target_of` of the script: the target's axes, angular momentum and eccentricity vector in these axes, mu = 1.
function targetOf(observation, constants) {
  const { units, axes, h_target, e_target, sees_target } = constants;
  if (!sees_target) {
    return { axes: [0, 1, 2].map((k) => rowOf(axes, k)), h: h_target.values, e: e_target.values };
  }
  const told = observation.slice(9, 9 + TOLD);
  const [perigee, normal] = [told.slice(0, 3), told.slice(3, 6)];
  const momentum = told[6] / (units.values[0] * units.values[3]);
  return { axes: [perigee, cross(normal, perigee), normal], h: [0, 0, momentum], e: [told[7], 0, 0] };
}

// The flight computer's mass: the nominal burn's, counted from the staging that has just been.
function computedMass(ascent) {
  const { rocket, vehicle, time, lastBurn } = ascent;
  const burn = vehicle.burnEnds.slice(0, lastBurn).filter((end) => end <= time).length;
  const began = burn > 0 ? vehicle.burnEnds[burn - 1] : 0;
  return Math.max(rocket.seen_mass[burn] - rocket.burns[burn].flow * (time - began), rocket.dry_mass);
}

// `motion` of the script: what follows from position and velocity, lengths in Earth radii, mu = 1.
function motionOf(observation, constants) {
  const { units } = constants;
  const target = targetOf(observation, constants);
  const scaledBy = observation.slice(0, 7).map((value, k) => value / units.values[k]);
  const inAxes = (vector) => target.axes.map((axis) => dot(axis, vector));
  const r = inAxes(scaledBy.slice(0, 3));
  const v = inAxes(scaledBy.slice(3, 6));
  const radius = norm(r);
  const speed = norm(v);
  const h = cross(r, v);
  const e = sum(cross(v, h), scaled(r, -1 / radius));
  const size = norm(target.h);
  return {
    r,
    v,
    target,
    altitude: 64 * (radius - 1), // 100 km
    climb: (8 * dot(r, v)) / radius, // km/s
    outOfPlane: [64 * r[2], 8 * v[2]],
    speed,
    energy: (speed * speed) / 2 - 1 / radius,
    error: [
      ...h.map((value, k) => (value - target.h[k]) / size),
      ...e.map((value, k) => value - target.e[k]),
    ],
    logMass: Math.log(scaledBy[6]),
    angle: Math.atan2(r[1], r[0]),
  };
}

// `features` of the script, in its order.
function rocketFeatures(constants, observation) {
  const motion = motionOf(observation, constants);
  const [timeLeft, phase] = observation.slice(7);
  const draw = observation.slice(constants.sees_target ? 9 + TOLD : 9);
  const last = constants.sees_target
    ? [...toTheTarget(motion), ...draw]
    : [...draw, ...differencesOf(constants, motion, phase)];
  const oneHot = Array.from(constants.phases.values, (other) => (Math.abs(phase - other) < 1e-3 ? 1 : 0));
  return [
    ...motion.r,
    ...motion.v,
    motion.altitude,
    motion.climb,
    ...motion.outOfPlane,
    motion.speed,
    timeLeft,
    motion.logMass,
    ...oneHot,
    ...motion.error,
    ...motion.error.map((value) => Math.tanh(10 * value)),
    ...last,
  ];
}

// `to_the_target` of the script.
function toTheTarget({ r, v, speed, target }) {
  const [momentum, eccentricity] = [target.h[2], target.e[0]];
  const energy = (eccentricity * eccentricity - 1) / (2 * momentum * momentum);
  const perigee = (momentum * momentum) / (1 + eccentricity);
  const missing = Math.sqrt(Math.max(2 * (energy + 1 / norm(r)), 0)) - speed;
  const inPlane = Math.hypot(r[0], r[1]);
  const tooHigh = inPlane - (momentum * momentum) / (1 + (eccentricity * r[0]) / inPlane);
  const tooFast = (r[0] * v[0] + r[1] * v[1]) / inPlane - (eccentricity * r[1]) / (inPlane * momentum);
  const left = Math.abs(missing) + LAST_STEP;
  const toMakeUp = [tooHigh / (left * left), r[2] / (left * left), tooFast / left, v[2] / left];
  return [
    8 * (momentum - 1),
    eccentricity,
    64 * (perigee - 1),
    energy,
    missing,
    Math.log1p(Math.max(missing, 0) / 0.01) / 5,
    64 * tooHigh,
    8 * tooFast,
    ...toMakeUp.map((value) => Math.asinh(2 * value)),
  ];
}

const LAST_STEP = 0.004; // of the circular speed: about what the last stage gains in a step

// What the flight differs by from the nominal one at the same phase and energy, in its own units and clipped;
// zeros where the policy has no nominal flight.
function differencesOf(constants, motion, phase) {
  const { nominal_flight, differences } = constants;
  if (!nominal_flight.values.some((value) => value !== 0)) {
    return Array.from(differences.values, () => 0);
  }
  const nominal = nominalAt(constants, phase, motion.energy);
  const compared = [...motion.error, motion.logMass, motion.angle];
  const limit = constants.direct ? FAR : NEAR;
  return compared.map((value, k) => clamp((value - nominal[k]) / differences.values[k], -limit, limit));
}

// `nominal_at` of the script: rows of burn, energy and what is compared; linear between two rows of a burn.
function nominalAt(constants, phase, energy) {
  const table = constants.nominal_flight;
  const [length, width] = table.shape;
  const burnOf = (k) => table.values[k * width];
  const energyOf = (k) => table.values[k * width + 1];
  const burn = Math.round(phase * (constants.phases.values.length - 1));
  const first = countWhile(length, (k) => burnOf(k) < burn);
  const last = countWhile(length, (k) => burnOf(k) <= burn) - 1;
  const begin = Math.min(first, length - 1);
  if (energyOf(last) - energyOf(begin) < 1e-6) {
    return rowOf(table, begin).slice(2); // a coast
  }
  const notBefore = countWhile(length, (k) => burnOf(k) + energyOf(k) < burn + energy);
  const after = Math.max(Math.min(Math.max(notBefore, first + 1), last), 1);
  const [low, high] = [rowOf(table, after - 1), rowOf(table, after)];
  const share = (energy - low[1]) / Math.max(high[1] - low[1], 1e-7);
  return low.slice(2).map((value, k) => value + share * (high[k + 2] - value));
}

// How many of the sorted places 0, 1, ... hold, the first ones.
function countWhile(length, holds) {
  let low = 0;
  let high = length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (holds(middle)) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low;
}

// The policy as a law of `flyAscent`. Its mean is a direction as up, along-track and cross-track.
function policyLaw(policy, changes) {
  const network = new Network(policy);
  network.constants.sees_target = policy.sees_target;
  return (ascent) => {
    const observation = observationOf(ascent, policy.options, changes);
    const local = unit(network.step(rocketFeatures(network.constants, observation)));
    const frame = localFrame(ascent.y, ascent.rocket.axes[2]);
    return sum(...frame.map((axis, k) => scaled(axis, local[k])));
  };
}

// ---------------------------------------------------------------------------------------------------------------------
// Classical laws. `optimum`: its flight t, u, y, and of LQR gains, axes, ignition (the step) and energy from there on
// ---------------------------------------------------------------------------------------------------------------------

const LARGEST_TILT = 0.1; // rad that each of LQR's two angles may turn a direction from the optimum's

// The optimum's directions by time, the last one held where a flight lasts longer.
function openLoop(optimum) {
  return (ascent) => rowOf(optimum.u, Math.min(ascent.t, optimum.u.shape[0] - 1));
}

// LQR about the optimum, with cut-off in the last burn by energy, else by time.
function lqrLaw(optimum, rocket) {
  const steps = optimum.u.shape[0];
  return (ascent) => {
    let place = Math.min(ascent.t, steps - 1); // along the optimum, in its steps
    if (rocket.cutoff && ascent.burn === ascent.lastBurn) {
      place = optimum.ignition + placeIn(optimum.energy.values, specificEnergy(ascent.y, rocket));
    }
    const step = Math.min(Math.floor(place), steps - 1);
    const part = place - step;
    const nearest = Math.min(Math.round(place), steps - 1);
    const [behind, ahead] = [rowOf(optimum.y, step), rowOf(optimum.y, step + 1)];
    const dx = ascent.y.slice(0, 6).map((value, k) => value - (1 - part) * behind[k] - part * ahead[k]);
    const gains = rowOf(optimum.gains, nearest);
    const axes = rowOf(optimum.axes, nearest);
    const turns = [0, 1].map((a) => {
      const angle = -dx.reduce((total, value, k) => total + gains[6 * a + k] * value, 0);
      const tilt = Math.tan(clamp(angle, -LARGEST_TILT, LARGEST_TILT));
      return scaled(axes.subarray(3 * a, 3 * a + 3), tilt);
    });
    return sum(rowOf(optimum.u, nearest), ...turns);
  };
}

// Where a value stands among sorted ones, as a number of places with its fraction, within them.
function placeIn(sorted, value) {
  const last = sorted.length - 1;
  if (value <= sorted[0]) {
    return 0;
  }
  if (value >= sorted[last]) {
    return last;
  }
  const high = countWhile(last, (k) => sorted[k] <= value);
  const low = high - 1;
  return low + (value - sorted[low]) / (sorted[high] - sorted[low]);
}

// All flights of a vehicle with these changes (`vehicleOf`): policy, open loop, LQR. To a target of its own (`changes`
// has one) the policy flies alone.
function flyAll(data, changes) {
  const { optimum, policy } = data;
  const rocket = changes.target ? withTarget(data.rocket, changes.target) : data.rocket;
  const vehicle = vehicleOf(rocket, changes);
  if (rocket.targets) {
    return { policy: flyAscent(rocket, vehicle, policyLaw(policy, changes)) };
  }
  return {
    policy: flyAscent(rocket, vehicle, policyLaw(policy, changes)),
    openLoop: flyAscent(rocket, vehicle, openLoop(optimum)),
    lqr: flyAscent(rocket, vehicle, lqrLaw(optimum, rocket)),
  };
}

// ---------------------------------------------------------------------------------------------------------------------
// Readings
// ---------------------------------------------------------------------------------------------------------------------

// The orbit on which a state would coast: apsides over Re in km (no apogee on a hyperbola: infinite), degrees.
function elementsOf(y, rocket) {
  const { h, e } = orbitVectors(y, rocket);
  const eccentricity = norm(e);
  const semiMajor = -rocket.mu / (2 * specificEnergy(y, rocket));
  const degrees = (radians) => ((((radians * 180) / Math.PI) % 360) + 360) % 360;
  const node = [-h[1], h[0], 0];
  const ahead = dot(e, cross(h, node)) / norm(h);
  return {
    a: semiMajor / 1e3,
    e: eccentricity,
    i: degrees(Math.atan2(Math.hypot(h[0], h[1]), h[2])),
    raan: degrees(Math.atan2(node[1], node[0])),
    argp: degrees(Math.atan2(ahead, dot(e, node))),
    perigee: (semiMajor * (1 - eccentricity) - rocket.Re) / 1e3,
    apogee: semiMajor > 0 ? (semiMajor * (1 + eccentricity) - rocket.Re) / 1e3 : Infinity,
  };
}

// The target orbit's state at its perigee.
function targetState(rocket) {
  const { a, e, axes, mu } = rocket;
  const speed = Math.sqrt(((mu / a) * (1 + e)) / (1 - e));
  return [...scaled(axes[0], a * (1 - e)), ...scaled(axes[1], speed)];
}

// The state of a flight at a time, straight between its steps; after its end the last one.
function stateAt(flight, time) {
  const place = placeIn(flight.t, time);
  const step = Math.min(Math.floor(place), flight.t.length - 2);
  const part = place - step;
  return flight.y[step].map((value, k) => (1 - part) * value + part * flight.y[step + 1][k]);
}

// The thrust's angle above the local horizon in degrees, at each step.
function pitchOf(flight) {
  return flight.u.map((u, k) => (Math.asin(clamp(dot(u, unit(flight.y[k])), -1, 1)) * 180) / Math.PI);
}
