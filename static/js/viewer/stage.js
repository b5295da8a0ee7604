// The 3D stage: points and camera frusta, orbit control, drawn only when something changed.

/** Vertical field of view, degrees. */
const FOV_DEG = 50;
/** Points looked at to find where the model is. */
const FIT_SAMPLE = 20000;
/** Share of the points that must be in view: a distant background must not shrink the object ... */
const FIT_SHARE = 0.75;
/** ... and the room around them, as a factor. */
const FIT_MARGIN = 1.15;
/** How far above the ground the view starts: as the cameras, within limits; `usual` where they stand all round. */
const FIT_ELEVATION_RAD = { lowest: 0.15, usual: 0.35, highest: 1.1 };
/** Cameras on one side of the object are looked at from this far round, so that they and the object stand apart. */
const FIT_AZIMUTH_RAD = 0.5;
/** The sphere in view may be this much larger than the object's own, to have the cameras in it. */
const FIT_GROWTH = 1.9;

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
    this.scalePoints();
    this.draw();
  }

  /** Points are sized in CSS pixels. */
  scalePoints() {
    this.material.uniforms.size.value = this.pointSize * this.renderer.getPixelRatio();
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

  /** Brings the model and, as far as that leaves it large enough, its cameras into view. */
  fit() {
    if (!this.cloud) return;
    const { three } = this;
    this.model.updateMatrixWorld(true);
    const { middle, reach } = bulkOf(this.cloud.positions);
    const centre = new three.Vector3(...middle).applyMatrix4(this.model.matrixWorld);
    const toward = new three.Vector3(0.6, 0, 1);
    let elevation = FIT_ELEVATION_RAD.usual;
    let radius = reach;
    if (this.cameras && this.cameras.positions.length > 0) {
      const cameras = bulkOf(this.cameras.positions);
      const from = new three.Vector3(...cameras.middle).applyMatrix4(this.model.matrixWorld).sub(centre);
      // The smallest sphere around both, its middle on the line between them, unless the object would be lost in it.
      const both = Math.min(0.5 * (from.length() + reach + cameras.reach), FIT_GROWTH * reach);
      radius = Math.max(reach, cameras.reach > from.length() ? Math.min(cameras.reach, FIT_GROWTH * reach) : both);
      // Cameras all round the object have their middle near its own: then any side is as good.
      if (from.length() > 0.6 * cameras.reach) {
        const { lowest, highest } = FIT_ELEVATION_RAD;
        elevation = Math.min(highest, Math.max(lowest, Math.atan2(from.y, Math.hypot(from.x, from.z))));
        if (Math.hypot(from.x, from.z) > 0.05 * from.length()) {
          const azimuth = Math.atan2(from.x, from.z) + FIT_AZIMUTH_RAD;
          toward.set(Math.sin(azimuth), 0, Math.cos(azimuth));
        }
        centre.addScaledVector(from.normalize(), Math.max(0, radius - reach));
      }
    }
    const narrow = Math.min(1, this.camera.aspect);
    const distance = (FIT_MARGIN * radius) / (Math.sin((FOV_DEG * Math.PI) / 360) * narrow);
    toward.normalize().multiplyScalar(Math.cos(elevation));
    toward.y = Math.sin(elevation);
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
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.scalePoints();
    // At once: a canvas whose size is set is empty, and would be shown so until the next frame.
    this.render();
  }

  /** Asks for the next frame to show the scene as it is then. */
  draw() {
    this.pending ??= requestAnimationFrame(() => {
      this.pending = null;
      this.render();
    });
  }

  render() {
    // Damping moves the view on, which asks for the next frame.
    this.controls.update();
    this.renderer.render(this.scene, this.camera);
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

/** Where most of the positions are: the median of each axis, and the distance from there within which `FIT_SHARE` of them lie. */
function bulkOf(positions) {
  const count = positions.length / 3;
  const step = Math.max(1, Math.floor(count / FIT_SAMPLE));
  const sample = [];
  for (let i = 0; i < count; i += step) sample.push(3 * i);
  const quantile = (values, share) => values.sort((a, b) => a - b)[Math.floor(share * (values.length - 1))];
  const middle = [0, 1, 2].map((axis) => quantile(sample.map((at) => positions[at + axis]), 0.5));
  const reach = quantile(sample.map((at) => Math.hypot(...middle.map((m, axis) => positions[at + axis] - m))), FIT_SHARE);
  return { middle, reach: Math.max(reach, 1e-9) };
}
