// The parts of three.js that the viewer uses; esbuild follows these names and leaves the rest out.
export {
  BufferAttribute,
  BufferGeometry,
  Color,
  GridHelper,
  Group,
  LineBasicMaterial,
  LineSegments,
  Matrix4,
  PerspectiveCamera,
  Points,
  Raycaster,
  Scene,
  ShaderMaterial,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
