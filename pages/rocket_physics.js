"use strict";

// A rocket's ascent: equations of motion, vehicles that differ from the table, and the environment's steps with exact
// events and cut-off. As rocket/dynamics.py, rocket/dispersion.py, rocket/failure.py and rocket/environment.py, of one
// flight. SI units; a state y is [r (3), v (3), m] in ECI. `rocket` are the constants that rocket/page.py writes.
// It needs numbers.js.

// ---------------------------------------------------------------------------------------------------------------------
// Equations of motion
// ---------------------------------------------------------------------------------------------------------------------

// The wind's velocity in ECI at r; wind: [east, north] in m/s where its profile over the altitude is 1.
function windVelocity(r, wind, rocket) {
  const radius = norm(r);
  const height = (radius - (rocket.Re + rocket.wind_altitude)) / rocket.wind_depth;
  const profile = Math.exp(-height * height);
  const axis = Math.hypot(r[0], r[1]) + 1e-9; // m from the Earth's axis; over a pole nothing is east, nor NaN
  const east = (profile * wind[0]) / axis;
  const north = (profile * wind[1]) / radius;
  const south = (north * r[2]) / axis;
  return [-east * r[1] - south * r[0], east * r[0] - south * r[1], north * axis];
}

// The derivative of y. control: {u, thrust, flow}; air: {wind, drag}, the factor on the drag.
function ascentRates(y, control, rocket, air) {
  const [rx, ry, rz, vx, vy, vz, m] = y;
  const r2 = rx * rx + ry * ry + rz * rz;
  const r = Math.sqrt(r2);
  const gravity = -rocket.mu / (r2 * r);
  const push = control.thrust / m;
  const blow = windVelocity([rx, ry, rz], air.wind, rocket);
  const relative = [vx + rocket.omega_e * ry - blow[0], vy - rocket.omega_e * rx - blow[1], vz - blow[2]];
  const rho = air.drag * rocket.rho0 * Math.exp((rocket.Re - r) / rocket.H);
  const drag = (-0.5 * rocket.Cd * rocket.S * rho * norm(relative)) / m;
  const acceleration = sum(scaled([rx, ry, rz], gravity), scaled(control.u, push), scaled(relative, drag));
  return [vx, vy, vz, ...acceleration, -control.flow];
}

// One classical Runge-Kutta step, the control held.
function rk4(rates, y, dt) {
  const moved = (slope, h) => y.map((value, k) => value + h * slope[k]);
  const k1 = rates(y);
  const k2 = rates(moved(k1, 0.5 * dt));
  const k3 = rates(moved(k2, 0.5 * dt));
  const k4 = rates(moved(k3, dt));
  return y.map((value, k) => value + (dt / 6) * (k1[k] + 2 * (k2[k] + k3[k]) + k4[k]));
}

// ---------------------------------------------------------------------------------------------------------------------
// Vehicles: what is constant between events
// ---------------------------------------------------------------------------------------------------------------------

const NO_CHANGES = { thrust: 0, drag: 0, windEast: 0, windNorth: 0, payload: 0, failure: null };

// How long a group of engines burns what it would burn in `seconds` if it stayed healthy. A loss {after, share} takes
// its share of thrust and flow after so many seconds of its burn.
function lasts(loss, seconds) {
  return Math.min(seconds, loss.after) + Math.max(seconds - loss.after, 0) / (1 - loss.share);
}

// In how long a healthy group would burn what this one burns in `seconds`.
function spent(loss, seconds) {
  return Math.min(seconds, loss.after) + Math.max(seconds - loss.after, 0) * (1 - loss.share);
}

// From the beginning of burn k on: seconds until the first engine is empty, and until the first that leaves then is due,
// that is, has burnt its nominal part of its propellant. Infinite where there is none. lasting: how long propellant
// lasts, as a part of the nominal time.
function secondsLeft(groups, k, lasting, lit, losses) {
  let untilEmpty = Infinity;
  let untilDue = Infinity;
  groups.forEach((group, g) => {
    if (!group.burns.includes(k) || group.seconds_full === null) {
      return;
    }
    untilEmpty = Math.min(untilEmpty, lasts(losses[g], group.seconds_full * lasting) - lit[g]);
    if (group.dropped_after === k) {
      untilDue = Math.min(untilDue, lasts(losses[g], group.seconds_lit * lasting) - lit[g]);
    }
  });
  return { untilEmpty, untilDue };
}

// Ends of the burns, the last one's when it runs dry; `burnOut`; and the seconds that each group burns. A burn that
// drops burning engines ends when the first of them is due, a coast after its nominal length, any other at its nominal
// time, and none goes on without an engine's propellant.
function burnEnds(rocket, lasting, losses) {
  const lit = rocket.groups.map(() => 0);
  const ends = [];
  let start = 0;
  let burnOut = 0;
  rocket.burns.forEach((burn, k) => {
    const { untilEmpty, untilDue } = secondsLeft(rocket.groups, k, lasting, lit, losses);
    const planned = burn.coast ? burn.end - rocket.burns[k - 1].end : burn.end - start;
    const due = Number.isFinite(untilDue) ? untilDue : planned;
    burnOut = start + Math.max(Math.min(due, untilEmpty), 0);
    const isLast = k === rocket.burns.length - 1;
    const end = isLast ? start + Math.max(untilEmpty, 0) : burnOut;
    rocket.groups.forEach((group, g) => {
      lit[g] += group.burns.includes(k) ? end - start : 0;
    });
    ends.push(end);
    start = end;
  });
  return { ends, burnOut, lit };
}

// The vehicle with these changes: `thrust` (a share: thrust and flow of all engines, so that they burn shorter), `drag`
// (a share), `windEast` and `windNorth` (m/s), `payload` (kg), `failure`, null or {time, group, share}: from that time
// on this group of engines has lost a share of thrust and flow, and burns until its propellant is spent.
function vehicleOf(rocket, changes) {
  const { groups, burns } = rocket;
  const rate = 1 + changes.thrust;
  const healthy = groups.map(() => ({ after: Infinity, share: 0 }));
  let losses = healthy;
  let strike = Infinity;
  if (changes.failure) {
    const { time, group, share } = changes.failure;
    const before = burnEnds(rocket, 1 / rate, healthy);
    losses = groups.map((_, g) => (g === group ? { after: litAt(rocket, before.ends, g, time), share } : healthy[g]));
    strike = time;
  }
  const { ends, burnOut, lit } = burnEnds(rocket, 1 / rate, losses);
  const dropped = burns.map(() => 0);
  groups.forEach((group, g) => {
    if (group.dropped_after < burns.length - 1) {
      const burnt = group.flow * rate * spent(losses[g], lit[g]);
      const unburnt = Math.max(group.propellant - burnt, 0);
      dropped[group.dropped_after] += group.number * (group.dry_mass + unburnt);
    }
  });
  const aboard = groups.map((group) => group.number * (group.dry_mass + group.propellant));
  const arcs = burns.map((burn, k) => ({
    burn: k,
    end: ends[k],
    thrust: burn.thrust * rate,
    flow: burn.flow * rate,
    dropped: dropped[k],
  }));
  arcs.push({ burn: burns.length - 1, end: Infinity, thrust: 0, flow: 0, dropped: 0 });
  return {
    mass: aboard.reduce((total, mass) => total + mass, rocket.payload + changes.payload),
    arcs: Number.isFinite(strike) ? struck(rocket, arcs, losses, rate, strike) : arcs,
    burnEnds: ends,
    burnOut,
    wind: [changes.windEast, changes.windNorth],
    drag: 1 + changes.drag,
  };
}

// The seconds that a group has burnt at a time; ends: those of the burns.
function litAt(rocket, ends, g, time) {
  return rocket.groups[g].burns.reduce((total, k) => {
    const begin = k > 0 ? ends[k - 1] : 0;
    return total + clamp(time - begin, 0, ends[k] - begin);
  }, 0);
}

// Whether a group of engines burns at a time in this vehicle.
function burnsAt(rocket, vehicle, g, time) {
  return rocket.groups[g].burns.some((k) => {
    const begin = k > 0 ? vehicle.burnEnds[k - 1] : 0;
    return begin <= time && time < vehicle.burnEnds[k];
  });
}

// Arcs of which the burn is cut in two where a failure strikes, behind it with the thrust and flow that are left.
function struck(rocket, arcs, losses, rate, strike) {
  const lost = (arc, name) =>
    rocket.groups.reduce((total, group, g) => {
      const isLit = group.burns.includes(arc.burn) && Number.isFinite(arc.end);
      return total + (isLit ? losses[g].share * group.number * group[name] * rate : 0);
    }, 0);
  const cut = arcs.findIndex((arc) => strike < arc.end);
  const before = { ...arcs[cut], end: strike, dropped: 0 };
  const after = arcs.slice(cut).map((arc) => ({
    ...arc,
    thrust: arc.thrust - lost(arc, "thrust"),
    flow: arc.flow - lost(arc, "flow"),
  }));
  return [...arcs.slice(0, cut), before, ...after];
}

// ---------------------------------------------------------------------------------------------------------------------
// Orbits
// ---------------------------------------------------------------------------------------------------------------------

function specificEnergy(y, rocket) {
  return (y[3] * y[3] + y[4] * y[4] + y[5] * y[5]) / 2 - rocket.mu / norm(y);
}

// Angular momentum and eccentricity vector.
function orbitVectors(y, rocket) {
  const r = y.slice(0, 3);
  const v = y.slice(3, 6);
  const h = cross(r, v);
  const e = sum(scaled(cross(v, h), 1 / rocket.mu), scaled(r, -1 / norm(r)));
  return { h, e };
}

// (h - h_T) / |h_T| and e - e_T, six numbers: zero exactly in the target orbit.
function terminalError(y, rocket) {
  const { h, e } = orbitVectors(y, rocket);
  const size = norm(rocket.h_target);
  const ofMomentum = h.map((value, k) => (value - rocket.h_target[k]) / size);
  return [...ofMomentum, ...e.map((value, k) => value - rocket.e_target[k])];
}

// The target at these changes {perigee, apogee (km), i, argp (degrees off its natural place)}, as `Targets.at` of
// rocket/targets.py: a rocket with this orbit. The plane is that through the launch site.
function withTarget(rocket, { perigee, apogee, i, argp }) {
  const { latitude, goes_south, own_argp_from_site } = rocket.targets;
  const radians = (degrees) => (degrees * Math.PI) / 180;
  const highest = Math.max(apogee, perigee);
  const [low, high] = [rocket.Re + 1e3 * perigee, rocket.Re + 1e3 * highest];
  const [a, e] = [(low + high) / 2, (high - low) / (high + low)];
  const ofPlane = (ratio) => Math.asin(clamp(ratio, -1, 1));
  const north = -ofPlane(Math.tan(radians(latitude)) / Math.tan(radians(i)));
  const above = ofPlane(Math.sin(radians(latitude)) / Math.sin(radians(i)));
  const [raan, site] = goes_south ? [Math.PI - north, Math.PI - above] : [north, above];
  return { ...rocket, ...orbitOf(rocket, a, e, radians(i), raan, site + radians(own_argp_from_site + argp)) };
}

// What a target orbit's elements (m and rad) make of a rocket's constants.
function orbitOf(rocket, a, e, i, raan, argp) {
  const [cosNode, sinNode, cosI, sinI] = [Math.cos(raan), Math.sin(raan), Math.cos(i), Math.sin(i)];
  const normal = [sinNode * sinI, -cosNode * sinI, cosI];
  const [cos, sin] = [Math.cos(argp), Math.sin(argp)];
  const perigee = [cosNode * cos - sinNode * sin * cosI, sinNode * cos + cosNode * sin * cosI, sin * sinI];
  return {
    a,
    e,
    axes: [perigee, cross(normal, perigee), normal],
    h_target: scaled(normal, Math.sqrt(rocket.mu * a * (1 - e * e))),
    e_target: scaled(perigee, e),
    target_energy: -rocket.mu / (2 * a),
  };
}

// Unit vectors up, along-track and cross-track at r, in the frame of the target's plane.
function localFrame(y, normal) {
  const up = unit(y);
  const along = unit(cross(normal, up));
  return [up, along, cross(up, along)];
}

// ---------------------------------------------------------------------------------------------------------------------
// The environment's steps
// ---------------------------------------------------------------------------------------------------------------------

const STIFF = 0.25; // drag's derivative by the speed, times the step: from here on a step is cut

class Ascent {
  constructor(rocket, vehicle) {
    this.rocket = rocket;
    this.vehicle = vehicle;
    this.y = [...rocket.x0.slice(0, 6), vehicle.mass];
    this.latest = rocket.ends_at_burn_out ? vehicle.burnOut : rocket.end_time;
    this.steps = Math.max(Math.ceil(this.latest / rocket.dt - 1e-9), 1);
    this.t = 0; // steps flown
    this.time = 0;
  }

  get lastBurn() {
    return this.rocket.burns.length - 1;
  }

  // The running step's begin, end and the arc in which it begins. After the last step that of the last one.
  schedule() {
    const { dt } = this.rocket;
    const at = dt * Math.min(this.t, this.steps - 1);
    return {
      begin: this.t >= this.steps ? this.latest : dt * this.t,
      end: this.t + 1 >= this.steps ? this.latest : dt * (this.t + 1),
      arc: this.vehicle.arcs.filter((arc) => arc.end <= at).length,
    };
  }

  // The burn, from 0, in which the running step begins: its phase.
  get burn() {
    return this.vehicle.arcs[this.schedule().arc].burn;
  }

  // Fly one step with the thrust's direction u, a unit vector in ECI; returns whether the flight has ended.
  advance(u) {
    const { begin, end, arc } = this.schedule();
    const step = { u, begin, end, arc };
    const before = this.y;
    let duration = end - begin;
    let done = this.t + 1 === this.steps;
    this.y = this.fly(before, step, duration);
    const excess = (y) => specificEnergy(y, this.rocket) - this.rocket.target_energy;
    if (this.rocket.cutoff && this.burn === this.lastBurn && excess(this.y) >= 0) {
      [this.y, duration] = this.cutOff(before, step, duration, excess);
      done = true;
    }
    this.crashed = norm(this.y) < this.rocket.Re;
    this.time = begin + duration;
    this.t += 1;
    return done || this.crashed;
  }

  // The state `duration` seconds after the step's begin: from event to event, each of which drops what is dropped.
  fly(y, step, duration) {
    let { begin, arc } = step;
    for (;;) {
      const { end, dropped } = this.vehicle.arcs[arc];
      const untilEvent = end - begin;
      y = this.flyArc(y, step.u, arc, Math.min(duration, untilEvent));
      // a duration is rounded: an event at the step's very end, which the next step takes as past, is met
      if (end > step.end || duration < untilEvent - 1e-9) {
        return y;
      }
      y[6] -= dropped;
      duration = Math.max(duration - untilEvent, 0);
      begin = end;
      arc += 1;
    }
  }

  // The state after dt seconds without an event: one Runge-Kutta step, several for a plunge into dense air.
  flyArc(y, u, arc, dt) {
    const { rocket, vehicle } = this;
    const { thrust, flow } = vehicle.arcs[arc];
    const rates = (state) => ascentRates(state, { u, thrust, flow }, rocket, vehicle);
    const speed = norm(y.slice(3, 6));
    const lowest = Math.max(norm(y) - rocket.Re - speed * dt, 0);
    const density = vehicle.drag * rocket.rho0 * Math.exp(-lowest / rocket.H);
    const stiffness = (density * rocket.Cd * rocket.S * speed * dt) / y[6];
    const parts = stiffness > STIFF ? Math.ceil(stiffness / STIFF) : 1;
    let after = rk4(rates, y, dt / parts);
    for (let k = 1; k < parts && norm(after) >= rocket.Re; k += 1) {
      after = rk4(rates, after, dt / parts); // below the ground it stays where it is
    }
    return after;
  }

  // The state and the seconds after the step's begin at which the excess of energy is 0: regula falsi with the Illinois
  // change, six evaluations.
  cutOff(before, step, duration, excess) {
    let low = 0;
    let high = duration;
    let fLow = Math.min(excess(before), -1e-300);
    let fHigh = excess(this.y);
    let replacedHigh = null;
    let y = this.y;
    let time = duration;
    for (let k = 0; k < 6; k += 1) {
      time = low - (fLow * (high - low)) / (fHigh - fLow);
      y = this.fly(before, step, time);
      const f = excess(y);
      const above = f >= 0;
      const divisor = above === replacedHigh ? 2 : 1;
      if (above) {
        [high, fHigh, fLow] = [time, f, fLow / divisor];
      } else {
        [low, fLow, fHigh] = [time, f, fHigh / divisor];
      }
      replacedHigh = above;
    }
    return [y, time];
  }
}

// Fly a vehicle by `law(ascent)`, which returns the thrust's direction in ECI of any length. Returns t (s), u and y,
// the terminal error and its norm, and how it ended.
function flyAscent(rocket, vehicle, law) {
  const ascent = new Ascent(rocket, vehicle);
  const flight = { t: [0], u: [], y: [[...ascent.y]], burnEnds: vehicle.burnEnds, mass: vehicle.mass };
  for (let done = false; !done;) {
    const u = unit(law(ascent));
    done = ascent.advance(u);
    flight.t.push(ascent.time);
    flight.u.push(u);
    flight.y.push([...ascent.y]);
  }
  flight.error = terminalError(ascent.y, rocket);
  flight.errorNorm = Math.hypot(...flight.error);
  flight.crashed = ascent.crashed;
  flight.dry = ascent.time >= vehicle.burnOut - 1e-6 && rocket.cutoff;
  return flight;
}
