"use strict";

// The page of a rocket: sliders, the button that takes thrust, time, readings and charts around the scene.
// It needs all other scripts of the page.

class AscentPage {
  constructor(data) {
    this.data = data;
    this.rocket = data.rocket;
    this.names = data.optima ? ["policy", "optimum"] : ["policy", "optimum", "openLoop", "lqr"];
    this.changes = { ...NO_CHANGES };
    this.time = 0;
    this.element = (id) => document.getElementById(id);
    this.element("longitude").textContent = data.launch_longitude;
    this.optimum = storedFlight(data.optimum, data.rocket);
    this.showLaws();
    this.altitude = new Chart(this.element("altitude"), { x: "time (s)", y: "altitude (km)" });
    this.pitch = new Chart(this.element("pitch"), { x: "time (s)", y: "thrust above the horizon (°)" });
    this.scene = this.makeScene();
    this.makeSliders();
    this.prepareFailure();
    this.prepareTime();
    const { error_norm, final_mass_kg, final_time_s } = data.python;
    this.element("python").textContent =
      `The same policy flown by Python, nominal vehicle: ‖error‖ ${error_norm.toFixed(7)}, ` +
      `${final_mass_kg.toFixed(2)} kg, ${final_time_s.toFixed(2)} s.`;
    this.fly();
    this.look("ascent");
    window.addEventListener("resize", () => this.drawCharts());
  }

  // Without WebGL the rest of the page works all the same.
  makeScene() {
    const container = this.element("scene");
    try {
      const scene = new Scene(container, this.data);
      container.querySelectorAll("button").forEach((button) => {
        button.addEventListener("click", () => this.look(button.dataset.view));
      });
      return scene;
    } catch (error) {
      container.textContent = `No picture in three dimensions: ${error.message}`;
      return { setFlights() {}, setRocket() {}, show() {}, look() {} };
    }
  }

  look(view) {
    this.scene.look(view);
    document.querySelectorAll("[data-view]").forEach((button) => {
      button.setAttribute("aria-pressed", button.dataset.view === view);
    });
  }

  // Leave out what a page of any orbit does not have: classical laws about one optimum, and other vehicles.
  showLaws() {
    const { optima } = this.data;
    const left = optima ? ".one-orbit" : ".any-orbit";
    document.querySelectorAll(left).forEach((element) => element.remove());
    if (!optima) {
      return;
    }
    this.optima = optima.map(({ target, ...flight }) => {
      const rocket = withTarget(this.data.rocket, target);
      return { target, rocket, flight: storedFlight(flight, rocket) };
    });
    const select = this.element("stored");
    this.optima.forEach(({ target }, k) => {
      const { perigee, apogee, i } = target;
      select.add(new Option(`${perigee.toFixed(0)} × ${apogee.toFixed(0)} km, ${i.toFixed(1)}°`, k));
    });
    select.addEventListener("change", () => this.aimAt(this.optima[Number(select.value)].target));
  }

  // -------------------------------------------------------------------------------------------------------------------
  // What a user changes
  // -------------------------------------------------------------------------------------------------------------------

  makeSliders() {
    if (this.data.optima) {
      this.makeTargetSliders();
      return;
    }
    this.sliders = this.data.sliders.map((slider) => {
      const label = document.createElement("label");
      label.innerHTML = `<span>${slider.label}</span><input type="range"><output></output>`;
      const input = label.querySelector("input");
      Object.assign(input, { id: slider.name, min: -slider.most, max: slider.most, step: slider.step, value: 0 });
      input.addEventListener("input", () => this.readSliders());
      this.element("sliders").appendChild(label);
      return { ...slider, input, output: label.querySelector("output") };
    });
    this.element("reset").addEventListener("click", () => {
      this.sliders.forEach(({ input }) => {
        input.value = 0;
      });
      this.changes.failure = null;
      this.readSliders();
    });
    this.showSliders();
  }

  makeTargetSliders() {
    this.sliders = this.data.sliders.map((slider) => {
      const { name, label, range, value, step, logarithmic } = slider;
      const [place, number] = logarithmic ? [Math.log, Math.exp] : [Number, Number];
      const row = document.createElement("label");
      row.innerHTML = `<span>${label}</span><input type="range"><output></output>`;
      const input = row.querySelector("input");
      const [min, max] = range.map(place);
      Object.assign(input, { id: name, min, max, step, value: place(value) });
      input.addEventListener("input", () => this.readTarget());
      this.element("sliders").appendChild(row);
      return { ...slider, input, place, number, output: row.querySelector("output") };
    });
    this.element("reset").addEventListener("click", () => {
      this.sliders.forEach(({ input, place, value }) => {
        input.value = place(value);
      });
      this.changes.target = null;
      this.showTarget(this.sliders.map(({ value }) => value));
      this.flySoon();
    });
    this.showTarget(this.sliders.map(({ value }) => value));
  }

  // Put the sliders to a target.
  aimAt(target) {
    this.sliders.forEach(({ name, input, place }) => {
      input.value = place(target[name]);
    });
    this.changes.target = { ...target };
    this.showTarget(this.sliders.map(({ name }) => target[name]));
    this.flySoon();
  }

  readTarget() {
    const values = this.sliders.map(({ input, number }) => number(Number(input.value)));
    this.changes.target = Object.fromEntries(this.sliders.map(({ name }, k) => [name, values[k]]));
    this.showTarget(values);
    this.flySoon();
  }

  showTarget(values) {
    this.sliders.forEach(({ output, unit }, k) => {
      output.textContent = `${values[k].toFixed(unit === "km" ? 0 : 1)} ${unit}`;
    });
  }

  // The optimum to show: that of the rocket's own orbit, or of the stored target that is nearest to the chosen one.
  chooseOptimum() {
    const { target } = this.changes;
    if (!target) {
      this.optimum = storedFlight(this.data.optimum, this.data.rocket);
      this.element("stored").value = "";
      this.element("nearest").textContent = "The optimum shown is that of this orbit.";
      return;
    }
    const away = (other) => Math.hypot(Math.log(other.apogee / target.apogee), (other.i - target.i) / 6);
    const order = this.optima.map((_, k) => k).sort((j, k) => away(this.optima[j].target) - away(this.optima[k].target));
    const { target: nearest, flight } = this.optima[order[0]];
    this.optimum = flight;
    this.element("stored").value = order[0];
    const isThis = this.sliders.every(({ name }) => Math.abs(nearest[name] - target[name]) < 1e-9);
    this.element("nearest").textContent = isThis
      ? "The optimum shown is that of this orbit."
      : "The optimum shown is that of the nearest stored orbit, which this list names. Choose it to compare.";
  }

  readSliders() {
    this.sliders.forEach(({ name, input, scale }) => {
      this.changes[name] = Number(input.value) * scale;
    });
    this.showSliders();
    this.flySoon();
  }

  showSliders() {
    this.sliders.forEach(({ input, output, unit, sigma, step }) => {
      const value = Number(input.value);
      const sign = value > 0 ? "+" : "";
      const digits = step < 1 ? 1 : 0;
      const inSigmas = `${sign}${(value / sigma).toFixed(1)} σ`;
      output.textContent = `${sign}${value.toFixed(digits)} ${unit} = ${inSigmas}`;
    });
  }

  prepareFailure() {
    if (this.data.optima) {
      return;
    }
    const select = this.element("engines");
    this.rocket.groups.forEach(({ name, thrust }, g) => {
      if (thrust > 0) {
        select.add(new Option(name, g));
      }
    });
    this.element("fail").addEventListener("click", () => {
      const [group, share] = [Number(select.value), Number(this.element("share").value)];
      this.changes.failure = { time: this.time, group, share };
      this.flySoon();
    });
  }

  // Only engines that burn now can lose thrust.
  showFailure() {
    if (this.data.optima) {
      return;
    }
    const select = this.element("engines");
    const options = [...select.options];
    options.forEach((option) => {
      option.disabled = !burnsAt(this.rocket, this.vehicle, Number(option.value), this.time);
    });
    const lit = options.filter((option) => !option.disabled);
    if (lit.length > 0 && (select.selectedIndex < 0 || select.selectedOptions[0].disabled)) {
      select.value = lit[lit.length - 1].value;
    }
    this.element("fail").disabled = lit.length === 0;
    const { failure } = this.changes;
    this.element("failure").textContent = failure
      ? `${this.rocket.groups[failure.group].name}: ${100 * failure.share} % of thrust and flow lost from ` +
        `${failure.time.toFixed(1)} s on; the burn lasts until its propellant is spent. No law is told.`
      : "The engines chosen lose thrust and propellant flow from the moment that the time slider shows.";
  }

  prepareTime() {
    this.element("time").addEventListener("input", (event) => this.show(Number(event.target.value)));
    this.element("play").addEventListener("click", () => {
      this.isPlaying = !this.isPlaying;
      this.element("play").textContent = this.isPlaying ? "pause" : "play";
      if (this.isPlaying) {
        this.show(this.time >= this.end ? 0 : this.time);
        this.shownAt = performance.now();
        requestAnimationFrame((now) => this.play(now));
      }
    });
  }

  play(now) {
    if (!this.isPlaying) {
      return;
    }
    const seconds = (Math.max(now - this.shownAt, 0) / 1000) * Number(this.element("speed").value);
    this.shownAt = now;
    this.show(Math.min(this.time + seconds, this.end));
    if (this.time >= this.end) {
      this.element("play").click();
    }
    requestAnimationFrame((next) => this.play(next));
  }

  // -------------------------------------------------------------------------------------------------------------------
  // What is flown and shown
  // -------------------------------------------------------------------------------------------------------------------

  // Fly when the slider has rested: a flight takes longer than a picture.
  flySoon() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.fly(), 50);
  }

  fly() {
    if (this.data.optima) {
      this.chooseOptimum();
      const { target } = this.changes;
      this.rocket = target ? withTarget(this.data.rocket, target) : this.data.rocket;
      this.scene.setRocket(this.rocket);
    }
    this.vehicle = vehicleOf(this.rocket, this.changes);
    this.flights = { ...flyAll(this.data, this.changes), optimum: this.optimum };
    this.end = Math.max(...this.names.map((name) => this.flights[name].t[this.flights[name].t.length - 1]));
    this.element("time").max = Math.ceil(10 * this.end) / 10;
    this.scene.setFlights(this.flights);
    this.showEnd();
    this.show(Math.min(this.time, this.end));
  }

  show(time) {
    this.time = time;
    this.element("time").value = time;
    this.element("clock").textContent = `${time.toFixed(1)} s`;
    this.showFailure();
    this.showNow();
    this.drawCharts();
    this.scene.show(time);
  }

  showNow() {
    const { Re } = this.rocket;
    const states = this.names.map((name) => stateAt(this.flights[name], this.time));
    const rows = [
      ["altitude (km)", (y) => ((norm(y) - Re) / 1e3).toFixed(3)],
      ["speed (km/s)", (y) => (norm(y.slice(3, 6)) / 1e3).toFixed(4)],
      ["mass (kg)", (y) => y[6].toFixed(1)],
      ["perigee (km)", (y) => distanceText(elementsOf(y, this.rocket).perigee)],
      ["apogee (km)", (y) => distanceText(elementsOf(y, this.rocket).apogee)],
    ];
    fillTable(
      this.element("now"),
      rows.map(([label, text]) => [label, ...states.map(text)]),
    );
  }

  showEnd() {
    const { rocket } = this;
    const flights = this.names.map((name) => this.flights[name]);
    const last = (flight) => flight.y[flight.y.length - 1];
    const target = elementsOf(targetState(rocket), rocket);
    const ofOrbit = (label, key, digits) => [
      label,
      ...flights.map((flight) => number(elementsOf(last(flight), rocket)[key], digits)),
      number(target[key], digits),
    ];
    fillTable(this.element("end"), [
      ["‖error‖", ...flights.map((flight) => flight.errorNorm.toFixed(7)), "0"],
      ofOrbit("perigee (km)", "perigee", 2),
      ofOrbit("apogee (km)", "apogee", 1),
      ofOrbit("inclination (°)", "i", 4),
      ofOrbit("node (°)", "raan", 3),
      ...(rocket.e > 0 ? [ofOrbit("arg. of perigee (°)", "argp", 3)] : []),
      ["mass (kg)", ...flights.map((flight) => last(flight)[6].toFixed(2)), ""],
      ["time (s)", ...flights.map((flight) => flight.t[flight.t.length - 1].toFixed(2)), ""],
      ["end", ...flights.map((flight) => howItEnded(flight, rocket)), ""],
    ]);
  }

  drawCharts() {
    const { Re } = this.rocket;
    const looks = { policy: { width: 2.2 }, optimum: { dash: [6, 4] }, openLoop: { width: 1 }, lqr: { width: 1 } };
    const order = ["openLoop", "lqr", "policy", "optimum"].filter((name) => this.names.includes(name));
    const altitudes = order.map((name) => {
      const { t, y } = this.flights[name];
      return { x: t, y: y.map((state) => (norm(state) - Re) / 1e3), color: COLORS[name], ...looks[name] };
    });
    const pitches = order.map((name) => {
      const flight = this.flights[name];
      return { ...heldLine(flight.t, pitchOf(flight)), color: COLORS[name], ...looks[name] };
    });
    const content = { xRange: [0, this.end], cursor: this.time };
    this.altitude.draw({ ...content, yRange: rangeOf(altitudes.map(({ y }) => y)), lines: altitudes });
    this.pitch.draw({ ...content, yRange: rangeOf(pitches.map(({ y }) => y)), lines: pitches });
  }
}

// A flight of the page's data, with its error from the target of `rocket`.
function storedFlight({ t, u, y }, rocket) {
  const rows = (array) => Array.from({ length: array.shape[0] }, (_, k) => Array.from(rowOf(array, k)));
  const flight = { t: Array.from(t.values), u: rows(u), y: rows(y) };
  const last = flight.y[flight.y.length - 1];
  return { ...flight, errorNorm: Math.hypot(...terminalError(last, rocket)) };
}

function number(value, digits) {
  return Number.isFinite(value) ? value.toFixed(digits) : "none";
}

// Kilometres of a state that may still stand on the ground.
function distanceText(value) {
  return number(value, Math.abs(value) < 1e4 ? 1 : 0);
}

function howItEnded(flight, rocket) {
  if (flight.crashed) {
    return "crashed";
  }
  if (flight.dry) {
    return "no fuel";
  }
  return rocket.cutoff ? "cut off" : "time";
}

function fillTable(body, rows) {
  const cells = (row) => row.map((cell) => `<td>${cell}</td>`).join("");
  body.innerHTML = rows.map((row) => `<tr>${cells(row)}</tr>`).join("");
}

const page = new AscentPage(decoded(JSON.parse(document.getElementById("data").textContent)));
