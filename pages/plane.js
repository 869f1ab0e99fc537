"use strict";

// The page of a small problem: its phase plane, in which the start is dragged.
// It needs numbers.js, policy.js, plane_physics.js, plane_optimum.js and chart.js.

class PlanePage {
  constructor(data) {
    this.data = data;
    this.problem = data.problem;
    this.plane = new Chart(document.getElementById("plane"), { x: "x₁", y: "x₂", equal: true });
    this.controls = new Chart(document.getElementById("controls"), { x: "time (s)", y: "u" });
    this.t = Array.from({ length: this.problem.steps + 1 }, (_, k) => k * this.problem.dt);
    this.prepareInputs();
    this.start = data.starts[0];
    this.fly();
  }

  prepareInputs() {
    const { canvas } = this.plane;
    const place = (event) => {
      const box = canvas.getBoundingClientRect();
      this.moveTo(this.plane.point(event.clientX - box.left, event.clientY - box.top));
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      place(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (canvas.hasPointerCapture(event.pointerId)) {
        place(event);
      }
    });
    this.numbers = ["x1", "x2"].map((id) => document.getElementById(id));
    this.numbers.forEach((input) => {
      input.addEventListener("change", () => this.moveTo(this.numbers.map((number) => Number(number.value))));
    });
    document.getElementById("random").addEventListener("click", () => {
      const { x0_max } = this.problem;
      this.moveTo(x0_max.map((bound) => bound * (2 * Math.random() - 1)));
    });
    window.addEventListener("resize", () => this.draw());
  }

  // Start from another point, within the box of the starts; flown with the next picture.
  moveTo(point) {
    const { x0_max } = this.problem;
    this.start = point.map((value, k) => clamp(value || 0, -x0_max[k], x0_max[k]));
    const isInside = point.every((value, k) => Math.abs(value) <= x0_max[k]);
    document.getElementById("box").textContent = isInside
      ? ""
      : `Starts lie within ±${x0_max[0]} and ±${x0_max[1]}: the policy has learned from these alone.`;
    if (!this.isWaiting) {
      this.isWaiting = true;
      requestAnimationFrame(() => {
        this.isWaiting = false;
        this.fly();
      });
    }
  }

  fly() {
    const { problem, start } = this;
    this.policy = flyPlane(problem, start, planePolicy(this.data.policy, problem));
    this.optimum = planeOptimum(problem, start);
    this.numbers.forEach((input, k) => {
      input.value = start[k].toFixed(3);
    });
    this.showReadings();
    this.draw();
  }

  showReadings() {
    const { policy, optimum } = this;
    const rows = [
      ["cost", policy.cost.toFixed(6), optimum.cost.toFixed(6)],
      ["policy / optimum", (policy.cost / optimum.cost).toFixed(6), ""],
    ];
    policy.hits.forEach((hit, k) => {
      if (this.problem.phases[k].radius === null) {
        return;
      }
      const words = (isHit) => (isHit ? "hit" : "missed");
      rows.push([`circle of phase ${k + 1}`, words(hit), words(optimum.hits[k])]);
    });
    const cells = rows.map((row) => `<tr>${row.map((cell) => `<td>${cell}</td>`).join("")}</tr>`);
    document.getElementById("readings").innerHTML = cells.join("");
  }

  draw() {
    const { policy, optimum, problem } = this;
    const line = (flight) => ({ x: flight.x.map((x) => x[0]), y: flight.x.map((x) => x[1]) });
    const both = [line(policy), line(optimum)];
    const [roomX, roomY] = problem.x0_max.map((bound) => [-1.15 * bound, 1.15 * bound]);
    const targets = problem.phases.map(({ target, radius }) => ({
      x: target[0],
      y: target[1],
      r: radius || 0,
      color: COLORS.target,
    }));
    const starts = this.data.starts.map(([x, y]) => ({ x, y, r: 1.5, color: "#bbb" }));
    this.plane.draw({
      xRange: rangeOf([roomX, ...both.map(({ x }) => x)], 0),
      yRange: rangeOf([roomY, ...both.map(({ y }) => y)], 0),
      lines: [
        { ...both[0], color: COLORS.policy, width: 2.2 },
        { ...both[1], color: COLORS.optimum, dash: [6, 4] },
      ],
      circles: targets,
      dots: [...starts, { x: this.start[0], y: this.start[1], r: 7, color: COLORS.policy }],
    });
    this.controls.draw({
      xRange: [0, this.t[problem.steps]],
      yRange: rangeOf([policy.u, optimum.u, [0]]),
      lines: [
        { ...heldLine(this.t, policy.u), color: COLORS.policy, width: 2.2 },
        { ...heldLine(this.t, optimum.u), color: COLORS.optimum, dash: [6, 4] },
      ],
    });
  }
}

const page = new PlanePage(decoded(JSON.parse(document.getElementById("data").textContent)));
