"use strict";

// The page of a rocket: sliders, the button that takes thrust, time, readings and charts around the scene.
// It needs all other scripts of the page.

const NAMES = ["policy", "optimum", "openLoop", "lqr"];

class AscentPage {
  constructor(data) {
    this.data = data;
    this.rocket = data.rocket;
    this.changes = { ...NO_CHANGES };
    this.time = 0;
    this.element = (id) => document.getElementById(id);
    this.optimum = this.storedOptimum();
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
    this.scene.look("ascent");
    window.addEventListener("resize", () => this.drawCharts());
  }

  // Without WebGL the rest of the page works all the same.
  makeScene() {
    const container = this.element("scene");
    try {
      const scene = new Scene(container, this.data);
      container.querySelectorAll("button").forEach((button) => {
        button.addEventListener("click", () => scene.look(button.dataset.view));
      });
      return scene;
    } catch (error) {
      container.textContent = `No picture in three dimensions: ${error.message}`;
      return { setFlights() {}, show() {}, look() {} };
    }
  }

  storedOptimum() {
    const { t, u, y } = this.data.optimum;
    const rows = (array) => Array.from({ length: array.shape[0] }, (_, k) => Array.from(rowOf(array, k)));
    const flight = { t: Array.from(t.values), u: rows(u), y: rows(y) };
    const last = flight.y[flight.y.length - 1];
    return { ...flight, errorNorm: Math.hypot(...terminalError(last, this.rocket)) };
  }

  // -------------------------------------------------------------------------------------------------------------------
  // What a user changes
  // -------------------------------------------------------------------------------------------------------------------

  makeSliders() {
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
    this.vehicle = vehicleOf(this.rocket, this.changes);
    this.flights = { ...flyAll(this.data, this.changes), optimum: this.optimum };
    this.end = Math.max(...NAMES.map((name) => this.flights[name].t[this.flights[name].t.length - 1]));
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
    const states = NAMES.map((name) => stateAt(this.flights[name], this.time));
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
    const flights = NAMES.map((name) => this.flights[name]);
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
    const order = ["openLoop", "lqr", "policy", "optimum"];
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
