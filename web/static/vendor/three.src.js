// What three.js in this folder is made from. To build it again:
//   npm install three@0.187.0 esbuild@0.28.2
//   npx esbuild three.src.js --bundle --minify --format=esm --legal-comments=none --outfile=three.js
export {
  BufferAttribute,
  BufferGeometry,
  Color,
  ColorManagement,
  Frustum,
  Group,
  Line,
  LineBasicMaterial,
  LinearSRGBColorSpace,
  LineSegments,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  PerspectiveCamera,
  Points,
  Raycaster,
  Scene,
  ShaderMaterial,
  Sphere,
  SphereGeometry,
  Vector2,
  Vector3,
  WebGLRenderer,
  WireframeGeometry,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
