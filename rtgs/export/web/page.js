// Splats, and over them glass: what lies behind passes its walls, the environment is reflected in them.
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const text = (id) => document.getElementById(id).textContent.trim();
const unpacked = async (id) =>
  new Response(new Blob([bytes(text(id))]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
const state = (value) => { document.body.dataset.state = value; };

const VERTEX = `
varying vec3 place; varying vec3 outward;
void main() {
  vec4 world = modelMatrix * vec4(position, 1.0);
  place = world.xyz;
  outward = mat3(modelMatrix) * normal;
  gl_Position = projectionMatrix * viewMatrix * world;
}`;

const FRAGMENT = `
uniform sampler2D behind, environment; uniform vec2 size; uniform vec3 center, tint;
uniform float distance_, index, scale; uniform bool linear_;
varying vec3 place; varying vec3 outward;
vec3 light(vec3 c) { return linear_ ? mix(pow((c + .055) / 1.055, vec3(2.4)), c / 12.92, lessThanEqual(c, vec3(.04045))) : c; }
vec3 shown(vec3 c) { return linear_ ? mix(1.055 * pow(c, vec3(1. / 2.4)) - .055, 12.92 * c, lessThanEqual(c, vec3(.0031308))) : c; }
vec3 around(vec3 from, vec3 along) {
  if (distance_ > 0.) {  // to where the ray meets a sphere about the place that was baked
    vec3 start = from - center;
    float half_ = dot(start, along);
    float root = half_ * half_ - dot(start, start) + distance_ * distance_;
    if (root > 0.) along = normalize(start + (sqrt(root) - half_) * along);
  }
  vec2 at = vec2(atan(along.x, -along.z) / 6.2831853 + .5, acos(clamp(along.y, -1., 1.)) / 3.14159265);
  return texture2D(environment, vec2(at.x, 1. - at.y)).rgb * scale;
}
void main() {
  vec3 ray = normalize(place - cameraPosition), n = normalize(outward);
  if (dot(ray, n) > 0.) n = -n;
  float c = clamp(-dot(ray, n), 1e-3, 1.), g = sqrt(index * index - 1. + c * c);
  float a = (c - g) / (c + g), b = (index * index * c - g) / (index * index * c + g);
  float once = .5 * (a * a + b * b), wall = 2. * once / (1. + once);
  vec3 back = light(texture2D(behind, gl_FragCoord.xy / size).rgb);
  vec3 front = light(around(place, reflect(ray, n)));
  gl_FragColor = vec4(shown((1. - wall) * tint * back + wall * front), 1.);
}`;

async function main() {
  const url = URL.createObjectURL(new Blob([await unpacked("vendor")], { type: "text/javascript" }));
  const V = await import(url);
  const model = JSON.parse(text("model"));
  const canvas = document.querySelector("canvas");
  const renderer = new V.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  renderer.autoClear = false;
  renderer.setClearColor(`rgb(${model.background})`, 1);
  const camera = new V.PerspectiveCamera(50, 1, model.near, model.far);
  const turn = new V.Matrix4().set(...model.turn);
  const layers = await Promise.all(["outside", "inside"].filter((id) => document.getElementById(id)).map(async (id) => {
    const scene = new V.Scene();
    scene.add(new V.SparkRenderer({ renderer, maxStdDev: 3 }));
    const mesh = new V.SplatMesh({ fileBytes: bytes(text(id)), fileType: "spz" });
    mesh.matrixAutoUpdate = false;
    // SPZ is right, up, backward: y and z of the capture with other signs
    mesh.matrix.copy(turn).multiply(new V.Matrix4().makeScale(1, -1, -1));
    mesh.matrix.decompose(mesh.position, mesh.quaternion, mesh.scale);
    scene.add(mesh);
    await mesh.initialized;
    return scene;
  }));
  const glass = model.glass ? await glassOf(V, model, turn) : null;

  const controls = new V.OrbitControls(camera, canvas);
  controls.enableDamping = true;
  const stand = (view) => {
    camera.position.set(...view.center);
    controls.target.set(...view.target);
    camera.fov = view.fov;
    fit();
    controls.update();
  };
  const fit = () => {
    const ratio = Math.min(devicePixelRatio, 2);
    renderer.setPixelRatio(ratio);
    renderer.setSize(innerWidth, innerHeight, false);
    camera.aspect = innerWidth / innerHeight;
    camera.updateProjectionMatrix();
    glass?.resize(Math.floor(innerWidth * ratio), Math.floor(innerHeight * ratio));
  };
  addEventListener("resize", fit);
  const views = model.views;
  const asked = Math.floor(Number(new URLSearchParams(location.hash.slice(1)).get("view"))) || 0;
  let at = Math.max(0, Math.min(asked, views.length - 1));
  stand(views[at]);
  document.getElementById("next").onclick = () => stand(views[at = (at + 1) % views.length]);
  const mirrors = document.getElementById("mirrors");
  if (glass) mirrors.onclick = () => { glass.on = !glass.on; mirrors.setAttribute("aria-pressed", glass.on); };
  else mirrors.hidden = true;

  let frames = 0;
  renderer.setAnimationLoop(() => {
    controls.update();
    renderer.clear();
    renderer.render(layers[0], camera);
    glass?.draw(renderer, camera, V.BackSide);
    if (layers[1]) { renderer.clearDepth(); renderer.render(layers[1], camera); }
    glass?.draw(renderer, camera, V.FrontSide);
    if (++frames === 30) state("shown");
  });
}

async function glassOf(V, model, turn) {
  const data = await unpacked("glass"), { vertices, faces } = model.glass;
  const geometry = new V.BufferGeometry();
  geometry.setAttribute("position", new V.BufferAttribute(new Float32Array(data, 0, 3 * vertices), 3));
  geometry.setAttribute("normal", new V.BufferAttribute(new Float32Array(data, 12 * vertices, 3 * vertices), 3));
  geometry.setIndex(new V.BufferAttribute(new Uint32Array(data, 24 * vertices, 3 * faces), 1));
  const picture = new Image();
  picture.src = "data:image/png;base64," + text("environment");
  await picture.decode();
  const environment = new V.Texture(picture);
  Object.assign(environment, { wrapS: V.RepeatWrapping, minFilter: V.LinearFilter, generateMipmaps: false, needsUpdate: true });
  const { index, tint, center, distance, scale, linear } = model.glass;
  const uniforms = {
    behind: { value: null }, environment: { value: environment }, size: { value: new V.Vector2() }, scale: { value: scale },
    center: { value: new V.Vector3(...center) }, tint: { value: new V.Vector3(...tint) }, index: { value: index },
    distance_: { value: distance }, linear_: { value: linear },
  };
  const material = new V.ShaderMaterial({ uniforms, vertexShader: VERTEX, fragmentShader: FRAGMENT });
  const mesh = new V.Mesh(geometry, material);
  mesh.frustumCulled = false;
  mesh.matrixAutoUpdate = false;
  mesh.matrix.copy(turn);
  const scene = new V.Scene();
  scene.add(mesh);
  return {
    on: true,
    resize(width, height) {
      uniforms.behind.value?.dispose();
      uniforms.behind.value = new V.FramebufferTexture(width, height);
      uniforms.size.value.set(width, height);
    },
    draw(renderer, camera, side) {
      if (!this.on) return;
      renderer.copyFramebufferToTexture(uniforms.behind.value);
      renderer.clearDepth();
      material.side = side;
      renderer.render(scene, camera);
    },
  };
}

main().catch((error) => {
  console.error(error);
  state("failed");
  document.getElementById("note").textContent = "This browser cannot show it (" + error.message + ")";
});
