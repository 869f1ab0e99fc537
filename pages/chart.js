"use strict";

// A chart on a canvas: lines, circles and dots between two axes.

// as page.css and drawing/style.py
const COLORS = { policy: "#d62728", optimum: "#1f77b4", target: "#2ca02c", openLoop: "#7f7f7f", lqr: "#ff9f1c" };
const MARGIN = { left: 52, right: 10, top: 8, bottom: 34 };

class Chart {
  // options: {x, y}, the axes' names, and `equal`, whether both have one scale.
  constructor(canvas, options) {
    this.canvas = canvas;
    this.options = options;
  }

  // Draw {xRange, yRange, lines: [{x, y, color, dash, width}], circles: [{x, y, r, color}], dots: [{x, y, r, color}],
  // cursor}, a value of x that a vertical line marks.
  draw(content) {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    this.wide = this.width - MARGIN.left - MARGIN.right;
    this.tall = this.height - MARGIN.top - MARGIN.bottom;
    this.canvas.width = this.width * ratio;
    this.canvas.height = this.height * ratio;
    const pen = this.canvas.getContext("2d");
    pen.scale(ratio, ratio);
    this.fit(content.xRange, content.yRange);
    this.drawAxes(pen);
    pen.save();
    pen.beginPath();
    pen.rect(MARGIN.left, MARGIN.top, this.wide, this.tall);
    pen.clip();
    (content.lines || []).forEach((line) => this.drawLine(pen, line));
    (content.circles || []).forEach((circle) => this.drawCircle(pen, circle, this.scaleX(circle.r), false));
    if (content.cursor !== undefined) {
      const [low, high] = this.yRange;
      this.drawLine(pen, { x: [content.cursor, content.cursor], y: [low, high], color: "#999", width: 1 });
    }
    pen.restore();
    (content.dots || []).forEach((dot) => this.drawCircle(pen, dot, dot.r, true));
  }

  // Set the ranges; with one scale for both axes the narrower one is widened about its middle.
  fit(xRange, yRange) {
    [this.xRange, this.yRange] = [[...xRange], [...yRange]];
    if (!this.options.equal) {
      return;
    }
    const perPixelX = (xRange[1] - xRange[0]) / this.wide;
    const perPixelY = (yRange[1] - yRange[0]) / this.tall;
    const widen = ([low, high], factor) => {
      const [middle, half] = [(low + high) / 2, ((high - low) / 2) * factor];
      return [middle - half, middle + half];
    };
    this.xRange = widen(xRange, Math.max(perPixelY / perPixelX, 1));
    this.yRange = widen(yRange, Math.max(perPixelX / perPixelY, 1));
  }

  // Pixels of a length along x.
  scaleX(length) {
    return (length * this.wide) / (this.xRange[1] - this.xRange[0]);
  }

  // The pixel of a point, and back.
  pixel(x, y) {
    const [low, high] = this.yRange;
    return [MARGIN.left + this.scaleX(x - this.xRange[0]), MARGIN.top + ((high - y) * this.tall) / (high - low)];
  }

  point(pixelX, pixelY) {
    const [low, high] = this.yRange;
    const x = this.xRange[0] + (pixelX - MARGIN.left) / this.scaleX(1);
    return [x, high - ((pixelY - MARGIN.top) * (high - low)) / this.tall];
  }

  drawAxes(pen) {
    const [left, bottom] = [MARGIN.left, this.height - MARGIN.bottom];
    pen.clearRect(0, 0, this.width, this.height);
    pen.font = "11px system-ui, sans-serif";
    pen.fillStyle = "#555";
    pen.lineWidth = 1;
    for (const tick of ticks(this.xRange, this.width / 90)) {
      const [x] = this.pixel(tick, 0);
      this.drawGridLine(pen, [x, MARGIN.top], [x, bottom]);
      pen.textAlign = "center";
      pen.fillText(String(tick), x, bottom + 14);
    }
    for (const tick of ticks(this.yRange, this.height / 45)) {
      const [, y] = this.pixel(0, tick);
      this.drawGridLine(pen, [left, y], [this.width - MARGIN.right, y]);
      pen.textAlign = "right";
      pen.fillText(String(tick), left - 5, y + 4);
    }
    pen.textAlign = "center";
    pen.fillText(this.options.x, (left + this.width) / 2, this.height - 5);
    pen.save();
    pen.translate(11, bottom / 2);
    pen.rotate(-Math.PI / 2);
    pen.fillText(this.options.y, 0, 0);
    pen.restore();
  }

  drawGridLine(pen, from, to) {
    pen.strokeStyle = "#e4e7ea";
    pen.beginPath();
    pen.moveTo(...from);
    pen.lineTo(...to);
    pen.stroke();
  }

  drawLine(pen, { x, y, color, dash = [], width = 1.6 }) {
    pen.strokeStyle = color;
    pen.lineWidth = width;
    pen.setLineDash(dash);
    pen.beginPath();
    for (let k = 0; k < x.length; k += 1) {
      const place = this.pixel(x[k], y[k]);
      if (k === 0) {
        pen.moveTo(...place);
      } else {
        pen.lineTo(...place);
      }
    }
    pen.stroke();
    pen.setLineDash([]);
  }

  drawCircle(pen, { x, y, color }, radius, isFilled) {
    pen.beginPath();
    pen.arc(...this.pixel(x, y), radius, 0, 2 * Math.PI);
    if (isFilled) {
      pen.fillStyle = color;
      pen.fill();
    } else {
      pen.strokeStyle = color;
      pen.lineWidth = 1.5;
      pen.stroke();
    }
  }
}

// Round numbers in a range, about as many as wanted.
function ticks([low, high], wanted) {
  const raw = (high - low) / Math.max(wanted, 2);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= raw);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) {
    found.push(Number((k * step).toFixed(digits)));
  }
  return found;
}

// A control that is held over each step, as a line with corners: times of the corners and values.
function heldLine(t, u) {
  return { x: u.flatMap((_, k) => [t[k], t[k + 1]]), y: u.flatMap((value) => [value, value]) };
}

// Least and greatest of some lists of numbers, with room.
function rangeOf(lists, room = 0.06) {
  let low = Infinity;
  let high = -Infinity;
  for (const value of lists.flat()) {
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  const more = room * (high - low || 1);
  return [low - more, high + more];
}
