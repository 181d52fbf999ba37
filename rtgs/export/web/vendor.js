// What pages take of three.js and Spark; bundled into vendor.js.gz by `make web`.
export {
  BackSide, BufferAttribute, BufferGeometry, DataTexture, FramebufferTexture, FrontSide, LinearFilter, Matrix4, Mesh,
  PerspectiveCamera, RepeatWrapping, RGBAFormat, Scene, ShaderMaterial, Texture, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
