"use strict";

// The globe and the flights in three dimensions, by three.js. Lengths are in Earth radii, axes those of ECI.
// It needs numbers.js, rocket_laws.js, chart.js for its colours, vendor/three.min.js and vendor/coastlines.js.

const LIGHT = { ...COLORS, policy: "#ff6b61", optimum: "#6ab0e0", openLoop: "#aaaaaa", target: "#5bd65b" }; // on a dark ground

class Scene {
  constructor(container, data) {
    this.container = container;
    this.rocket = data.rocket;
    this.longitude = (data.launch_longitude * Math.PI) / 180;
    // of the whole range of distances, from a stage to an orbit
    this.renderer = new THREE.WebGLRenderer({ antialias: true, logarithmicDepthBuffer: true });
    this.renderer.setPixelRatio(window.devicePixelRatio || 1);
    container.appendChild(this.renderer.domElement);
    this.camera = new THREE.PerspectiveCamera(40, 1, 1e-4, 200);
    this.world = new THREE.Scene();
    this.earth = this.makeEarth();
    this.world.add(this.earth);
    this.paths = {};
    this.dots = {};
    this.setRocket(data.rocket);
    const laws = data.optima ? [] : ["openLoop", "lqr"];
    for (const name of [...laws, "policy", "optimum"]) {
      this.dots[name] = new THREE.Mesh(
        new THREE.SphereGeometry(1, 16, 12),
        new THREE.MeshBasicMaterial({ color: LIGHT[name] }),
      );
      this.world.add(this.dots[name]);
    }
    this.flame = new THREE.ArrowHelper(new THREE.Vector3(1, 0, 0), new THREE.Vector3(), 1, "#ffcc66");
    this.world.add(this.flame);
    this.orbit = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: LIGHT.policy }));
    this.orbit.frustumCulled = false;
    this.world.add(this.orbit);
    this.focus = new THREE.Vector3();
    this.prepareMouse();
    new ResizeObserver(() => this.resize()).observe(container);
  }

  // The ground, meridians and parallels, coastlines; turned as the Earth turns.
  makeEarth() {
    const group = new THREE.Group();
    const ball = new THREE.SphereGeometry(0.998, 128, 64);
    ball.rotateX(Math.PI / 2); // its poles lie on y
    group.add(new THREE.Mesh(ball, new THREE.MeshBasicMaterial({ color: "#1c3145" })));
    const steps = Array.from({ length: 73 }, (_, k) => k * 5);
    for (let angle = 0; angle < 180; angle += 15) {
      group.add(
        makeLine(
          steps.map((latitude) => onGround(angle, latitude)),
          "#35506a",
        ),
      );
      group.add(
        makeLine(
          steps.map((longitude) => onGround(longitude, angle - 90)),
          "#35506a",
        ),
      );
    }
    if (this.rocket.body === "Earth") {
      for (const coast of COASTLINES) {
        const points = Array.from({ length: coast.length / 2 }, (_, k) => onGround(coast[2 * k], coast[2 * k + 1]));
        group.add(makeLine(points, "#8fa9bf"));
      }
    }
    return group;
  }

  // The closed orbit through a state, as points; none on a hyperbola.
  orbitPoints(y) {
    const { h, e } = orbitVectors(y, this.rocket);
    const eccentricity = norm(e);
    if (eccentricity >= 1) {
      return [];
    }
    const perigee = eccentricity > 1e-9 ? unit(e) : unit(y);
    const ahead = cross(unit(h), perigee);
    const parameter = dot(h, h) / this.rocket.mu / this.rocket.Re;
    return Array.from({ length: 361 }, (_, k) => {
      const angle = (k * Math.PI) / 180;
      const radius = parameter / (1 + eccentricity * Math.cos(angle));
      return sum(scaled(perigee, radius * Math.cos(angle)), scaled(ahead, radius * Math.sin(angle)));
    });
  }

  place(y) {
    return scaled(y, 1 / this.rocket.Re);
  }

  // Show the target orbit of this rocket.
  setRocket(rocket) {
    this.rocket = rocket;
    if (this.target) {
      this.world.remove(this.target);
      this.target.geometry.dispose();
    }
    this.target = makeLine(this.orbitPoints(targetState(rocket)), LIGHT.target);
    this.world.add(this.target);
  }

  // Show these flights, by name.
  setFlights(flights) {
    for (const [name, flight] of Object.entries(flights)) {
      if (this.paths[name]) {
        this.world.remove(this.paths[name]);
        this.paths[name].geometry.dispose();
      }
      this.paths[name] = makeLine(
        flight.y.map((y) => this.place(y)),
        LIGHT[name],
        name === "optimum",
      );
      this.world.add(this.paths[name]);
    }
    this.flights = flights;
  }

  // Show a moment of all flights.
  show(time) {
    this.time = time;
    this.earth.rotation.z = this.rocket.omega_e * time - this.longitude;
    for (const [name, flight] of Object.entries(this.flights)) {
      this.dots[name].position.set(...this.place(stateAt(flight, time)));
    }
    const { policy } = this.flights;
    const y = stateAt(policy, time);
    const step = Math.min(policy.t.filter((moment) => moment <= time).length, policy.u.length) - 1;
    this.flame.visible = time < policy.t[policy.t.length - 1];
    this.flame.setDirection(new THREE.Vector3(...policy.u[step]));
    this.flame.position.copy(this.dots.policy.position);
    this.orbit.geometry.dispose();
    this.orbit.geometry = geometryOf(this.orbitPoints(y));
    this.render();
  }

  // Look from "ascent", "rocket", "globe" or "orbit".
  look(view) {
    this.isFollowing = view === "rocket";
    const { y } = this.flights.policy;
    const [begin, end] = [unit(y[0]), unit(y[y.length - 1])];
    const middle = unit(sum(begin, end));
    const way = sum(end, scaled(begin, -1));
    const span = Math.max(norm(way), 0.05);
    const side = scaled(this.rocket.axes[2], -1);
    const local = { up: middle, level: unit(way) }; // whatever the latitude, the ascent goes up in the picture
    const eci = { up: [0, 0, 1], level: [1, 0, 0] };
    const places = {
      ascent: { ...local, focus: scaled(middle, 1.01), from: sum(scaled(side, 1.15 * span), scaled(middle, 0.5 * span)) },
      rocket: { ...local, focus: [0, 0, 0], from: sum(scaled(side, 0.06), scaled(middle, 0.035)) },
      globe: { ...eci, focus: [0, 0, 0], from: scaled(sum(middle, scaled(side, 0.7)), 3.4) },
      orbit: { ...eci, focus: this.orbitCentre(), from: scaled(sum(side, scaled(middle, 0.4)), this.orbitSize()) },
    };
    const { up, level, focus, from } = places[view];
    this.axes = [level, cross(up, level), up]; // of azimuth and elevation
    this.camera.up.set(...up);
    this.focus.set(...focus);
    this.radius = norm(from) * Math.max(1, 1.2 / this.camera.aspect); // further away where the picture is narrow
    const along = this.axes.map((axis) => dot(axis, from));
    this.azimuth = Math.atan2(along[1], along[0]);
    this.elevation = Math.asin(along[2] / norm(from));
    this.render();
  }

  orbitCentre() {
    const { a, e, axes, Re } = this.rocket;
    return scaled(axes[0], (-a * e) / Re);
  }

  orbitSize() {
    return (3.2 * this.rocket.a) / this.rocket.Re;
  }

  // Drag to turn, wheel to come nearer.
  prepareMouse() {
    const { domElement } = this.renderer;
    domElement.addEventListener("pointerdown", (event) => domElement.setPointerCapture(event.pointerId));
    domElement.addEventListener("pointermove", (event) => {
      if (domElement.hasPointerCapture(event.pointerId)) {
        this.azimuth -= event.movementX / 200;
        this.elevation = clamp(this.elevation + event.movementY / 200, -1.55, 1.55);
        this.render();
      }
    });
    domElement.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.radius = clamp(this.radius * Math.exp(event.deltaY / 800), 0.01, 80);
        this.render();
      },
      { passive: false },
    );
  }

  resize() {
    const { clientWidth, clientHeight } = this.container;
    this.renderer.setSize(clientWidth, clientHeight);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.render();
  }

  render() {
    if (!this.flights || this.radius === undefined) {
      return;
    }
    if (this.isFollowing) {
      this.focus.copy(this.dots.policy.position);
    }
    const flat = this.radius * Math.cos(this.elevation);
    const along = [flat * Math.cos(this.azimuth), flat * Math.sin(this.azimuth), this.radius * Math.sin(this.elevation)];
    const from = sum(...this.axes.map((axis, k) => scaled(axis, along[k])));
    this.camera.position.set(...sum(from, this.focus.toArray()));
    this.camera.lookAt(this.focus);
    for (const [name, dot] of Object.entries(this.dots)) {
      const away = this.camera.position.distanceTo(dot.position);
      dot.scale.setScalar(away * (name === "policy" ? 0.008 : 0.005));
    }
    const away = this.camera.position.distanceTo(this.flame.position);
    this.flame.setLength(0.09 * away, 0.02 * away, 0.012 * away);
    this.renderer.render(this.world, this.camera);
  }
}

// A point on the ground in the Earth's own axes, of degrees.
function onGround(longitude, latitude) {
  const [east, north] = [(longitude * Math.PI) / 180, (latitude * Math.PI) / 180];
  return scaled([Math.cos(north) * Math.cos(east), Math.cos(north) * Math.sin(east), Math.sin(north)], 0.9995);
}

function geometryOf(points) {
  return new THREE.BufferGeometry().setFromPoints(points.map((point) => new THREE.Vector3(...point)));
}

function makeLine(points, color, isDashed = false) {
  const material = isDashed
    ? new THREE.LineDashedMaterial({ color, dashSize: 0.012, gapSize: 0.008 })
    : new THREE.LineBasicMaterial({ color });
  const line = new THREE.Line(geometryOf(points), material);
  return isDashed ? line.computeLineDistances() : line;
}
