// The 3D stage: points and camera frusta, orbit control, drawn only when something changed.

/** Vertical field of view, degrees. */
const FOV_DEG = 50;
/** Points looked at to find where the model is. */
const FIT_SAMPLE = 20000;
/** Share of the points on either side that may lie outside the view: stray points far off must not shrink the model. */
const FIT_TAIL = 0.04;

const VERTEX = `
  attribute vec3 tint;
  varying vec3 vTint;
  uniform float size;
  uniform float reference;
  void main() {
    vTint = tint;
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    gl_Position = projectionMatrix * seen;
    // Nearer points are larger, within limits, which gives depth without hiding the far ones.
    gl_PointSize = size * clamp(reference / -seen.z, 0.6, 3.0);
  }`;

const FRAGMENT = `
  varying vec3 vTint;
  void main() {
    vec2 off = gl_PointCoord - 0.5;
    if (dot(off, off) > 0.25) discard;
    gl_FragColor = vec4(vTint, 1.0);
  }`;

/** Turns that bring an axis of the model up (three.js has y up). */
const UP_TURNS = { z: [-Math.PI / 2, 0, 0], "-z": [Math.PI / 2, 0, 0], y: [0, 0, 0], "-y": [Math.PI, 0, 0], x: [0, 0, Math.PI / 2], "-x": [0, 0, -Math.PI / 2] };

export class Stage {
  /**
   * @param {typeof import("../../vendor/three.js")} three
   * @param {HTMLCanvasElement} canvas
   */
  constructor(three, canvas) {
    this.three = three;
    this.canvas = canvas;
    this.renderer = new three.WebGLRenderer({ canvas, antialias: true });
    this.renderer.setClearColor(0x14171a);
    this.scene = new three.Scene();
    this.model = new three.Group();
    this.scene.add(this.model);
    this.model.rotation.set(...UP_TURNS.z);
    this.camera = new three.PerspectiveCamera(FOV_DEG, 1, 0.01, 1000);
    this.controls = new three.OrbitControls(this.camera, canvas);
    this.controls.enableDamping = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.controls.dampingFactor = 0.12;
    this.controls.zoomToCursor = true;
    this.material = new three.ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: { size: { value: 2 }, reference: { value: 1 } } });
    this.points = null;
    this.frusta = null;
    this.chosen = null;
    this.pointSize = 2;
    this.pending = null;
    this.controls.addEventListener("change", () => this.draw());
    this.resizer = new ResizeObserver(() => this.resize());
    this.resizer.observe(canvas);
    canvas.addEventListener("webglcontextrestored", () => this.draw());
    this.resize();
  }

  /** Shows a cloud and, where given, frusta; both as `parsePly` returns them. */
  show(cloud, cameras) {
    const { three } = this;
    this.clear();
    const geometry = new three.BufferGeometry();
    geometry.setAttribute("position", new three.BufferAttribute(cloud.positions, 3));
    const colors = cloud.colors ?? new Uint8Array(cloud.positions.length).fill(200);
    geometry.setAttribute("tint", new three.BufferAttribute(colors, 3, true));
    this.points = new three.Points(geometry, this.material);
    this.points.frustumCulled = false;
    this.model.add(this.points);
    this.cloud = cloud;
    this.cameras = cameras;
    if (cameras && cameras.lines.length > 0) {
      const lines = new three.BufferGeometry();
      lines.setAttribute("position", new three.BufferAttribute(cameras.positions, 3));
      lines.setIndex(new three.BufferAttribute(cameras.lines, 1));
      this.frusta = new three.LineSegments(lines, new three.LineBasicMaterial({ color: 0xf2a65a, transparent: true, opacity: 0.85 }));
      this.frusta.frustumCulled = false;
      this.model.add(this.frusta);
    }
    this.fit();
  }

  setPointSize(pixels) {
    this.pointSize = pixels;
    this.resize();
  }

  showCameras(visible) {
    if (this.frusta) this.frusta.visible = visible;
    if (this.chosen) this.chosen.visible = visible;
    this.draw();
  }

  /** Draws the frustum of the `count` vertices from `first` in another colour; null: none. */
  highlight(first, count) {
    this.dropChosen();
    if (first !== null) {
      const { three } = this;
      const inside = (vertex) => vertex >= first && vertex < first + count;
      const pairs = [];
      for (let k = 0; k < this.cameras.lines.length; k += 2) {
        if (inside(this.cameras.lines[k])) pairs.push(this.cameras.lines[k], this.cameras.lines[k + 1]);
      }
      const lines = new three.BufferGeometry();
      lines.setAttribute("position", this.frusta.geometry.getAttribute("position"));
      lines.setIndex(new three.BufferAttribute(Uint32Array.from(pairs), 1));
      // Over everything else, so that it is seen through the points.
      this.chosen = new three.LineSegments(lines, new three.LineBasicMaterial({ color: 0x7fe3ff, depthTest: false, transparent: true }));
      this.chosen.frustumCulled = false;
      this.chosen.renderOrder = 1;
      this.model.add(this.chosen);
    }
    this.draw();
  }

  dropChosen() {
    if (!this.chosen) return;
    this.model.remove(this.chosen);
    this.chosen.geometry.dispose();
    this.chosen.material.dispose();
    this.chosen = null;
  }

  /** Which axis of the model points up: "z", "-y", ... */
  setUp(axis) {
    this.model.rotation.set(...UP_TURNS[axis]);
    this.fit();
  }

  /** Brings the model into view, looked at from where the pictures were taken and a little above. */
  fit() {
    if (!this.cloud) return;
    const { three } = this;
    this.model.updateMatrixWorld(true);
    const middle = robustBox(this.cloud.positions, FIT_TAIL);
    const centre = new three.Vector3(...middle.centre).applyMatrix4(this.model.matrixWorld);
    let radius = middle.radius;
    const toward = new three.Vector3(0.6, 0, 1);
    if (this.cameras && this.cameras.positions.length > 0) {
      const around = robustBox(this.cameras.positions, 0);
      const from = new three.Vector3(...around.centre).applyMatrix4(this.model.matrixWorld).sub(centre);
      from.y = 0;
      // Cameras all round the object have their middle near its own: then any side is as good.
      if (from.length() > 0.2 * radius) toward.copy(from.normalize());
      radius = Math.max(radius, Math.min(1.6 * radius, 0.6 * around.radius));
    }
    toward.normalize();
    toward.y = 0.4;
    toward.normalize();
    const half = (FOV_DEG * Math.PI) / 360;
    const narrow = Math.min(1, this.camera.aspect);
    const distance = (0.95 * radius) / (Math.sin(half) * narrow);
    this.camera.near = distance / 500;
    this.camera.far = distance * 200;
    this.camera.position.copy(centre).addScaledVector(toward, distance);
    this.controls.target.copy(centre);
    this.material.uniforms.reference.value = distance;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.draw();
  }

  /** Turns the view about its target, by angles in radians. */
  turn(azimuth, elevation) {
    const { three } = this;
    const arm = this.camera.position.clone().sub(this.controls.target);
    const length = arm.length();
    const polar = Math.min(Math.PI - 0.05, Math.max(0.05, Math.acos(arm.y / length) - elevation));
    const around = Math.atan2(arm.x, arm.z) + azimuth;
    arm.copy(new three.Vector3(Math.sin(polar) * Math.sin(around), Math.cos(polar), Math.sin(polar) * Math.cos(around))).multiplyScalar(length);
    this.camera.position.copy(this.controls.target).add(arm);
    this.controls.update();
    this.draw();
  }

  /** Comes nearer (factor under 1) or goes away. */
  zoom(factor) {
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
    this.draw();
  }

  /** The frustum vertex nearest to a place on the canvas (CSS pixels), within a few pixels, as its number; else null. */
  cameraAt(x, y, reach = 14) {
    if (!this.frusta?.visible) return null;
    const { three } = this;
    const matrix = new three.Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse).multiply(this.model.matrixWorld);
    const place = new three.Vector3();
    const { positions } = this.cameras;
    let best = null;
    let nearest = reach;
    for (let i = 0; i < positions.length / 3; i += 1) {
      place.fromArray(positions, 3 * i).applyMatrix4(matrix);
      if (place.z < -1 || place.z > 1) continue;
      const off = Math.hypot(((place.x + 1) / 2) * this.canvas.clientWidth - x, ((1 - place.y) / 2) * this.canvas.clientHeight - y);
      if (off < nearest) {
        nearest = off;
        best = i;
      }
    }
    return best;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    const ratio = Math.min(devicePixelRatio, 2);
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.material.uniforms.size.value = this.pointSize * ratio;
    this.draw();
  }

  draw() {
    this.pending ??= requestAnimationFrame(() => {
      this.pending = null;
      // Damping moves the view on, which asks for the next frame.
      this.controls.update();
      this.renderer.render(this.scene, this.camera);
    });
  }

  clear() {
    this.dropChosen();
    for (const object of [this.points, this.frusta]) {
      if (!object) continue;
      this.model.remove(object);
      object.geometry.dispose();
    }
    this.frusta?.material.dispose();
    this.points = this.frusta = this.cloud = this.cameras = null;
  }

  close() {
    cancelAnimationFrame(this.pending);
    this.resizer.disconnect();
    this.clear();
    this.controls.dispose();
    this.material.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }
}

/** Centre and radius of a box that leaves out the given share of the points on either side of each axis. */
function robustBox(positions, tail) {
  const count = positions.length / 3;
  const step = Math.max(1, Math.floor(count / FIT_SAMPLE));
  const centre = [0, 0, 0];
  let sum = 0;
  for (let axis = 0; axis < 3; axis += 1) {
    const values = [];
    for (let i = 0; i < count; i += step) values.push(positions[3 * i + axis]);
    values.sort((a, b) => a - b);
    const low = values[Math.floor(tail * (values.length - 1))] ?? 0;
    const high = values[Math.ceil((1 - tail) * (values.length - 1))] ?? 0;
    centre[axis] = (low + high) / 2;
    sum += ((high - low) / 2) ** 2;
  }
  return { centre, radius: Math.max(Math.sqrt(sum), 1e-9) };
}
