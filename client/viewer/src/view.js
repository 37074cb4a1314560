// The picture: the model of a world, drawn at the tick that a clock or a player says.
import * as THREE from 'three';
import { BodyView } from './body_view.js';
import { OrbitCamera } from './camera.js';
import { LiveClock } from './clock.js';
import { Model } from './model.js';
import { Overlays } from './overlays.js';
import { pickBody } from './pick.js';
import { SceneView, background } from './scene_view.js';
import { extentOf } from './shapes.js';

const groundReach = 6;  // of what is in the world

export function isSoftware(gl) {
  const info = gl.getExtension('WEBGL_debug_renderer_info');
  const name = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  return /swiftshader|llvmpipe|software/i.test(name);
}

// Smoothing edges costs a software renderer most of its time.
function makeRenderer(canvas) {
  const probe = document.createElement('canvas').getContext('webgl2');
  const software = probe === null || isSoftware(probe);
  probe?.getExtension('WEBGL_lose_context')?.loseContext();
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: !software, powerPreference: 'high-performance' });
  renderer.setPixelRatio(Math.min(1, window.devicePixelRatio));
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  renderer.setClearColor(background);
  return renderer;
}

export class View {
  constructor(canvas) {
    THREE.ColorManagement.enabled = false;
    this.canvas = canvas;
    this.renderer = makeRenderer(canvas);
    const software = isSoftware(this.renderer.getContext());
    // Bodies of a smaller radius, in pixels, are drawn with few corners.
    this.finePixels = software ? 9 : 5;
    this.scene = new THREE.Scene();
    this.camera = new OrbitCamera();
    this.sceneView = new SceneView(this.scene, software);
    this.bodyView = new BodyView(this.scene, software);
    this.overlays = new Overlays(this.scene);
    this.clock = new LiveClock();
    this.player = null;
    this.tick = 0;  // shown
    this.framed = false;
    this.stale = true;
    this.frames = 0;
    this.afterDraw = [];  // called once, after the next picture
    this.model = new Model({
      changed: (body, before) => this.#changed(body, before),
      lost: (body) => this.#lost(body),
      reset: () => this.bodyView.reset(),
    });
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.camera.resize(width, height);
    this.stale = true;
  }

  // Of the screen's pixels: fewer are drawn faster, and less sharp.
  setPixelRatio(ratio) {
    this.renderer.setPixelRatio(ratio);
    this.stale = true;
  }

  setWorld() {
    this.clock.reset();
    this.framed = false;
    this.overlays.clearAuras();
    this.sceneView.set(this.model.world.scene, 100);
    this.#layOut(this.sceneView.bounds());
    this.select(null);
  }

  // Regions have come or gone, or have other borders.
  setLayout() {
    if (this.framed) this.#layOut(this.#middle());
  }

  select(id) {
    this.bodyView.select(id);
    this.stale = true;
  }

  selected() {
    return this.bodyView.selected === null ? null : this.bodyView.views.get(this.bodyView.selected) ?? null;
  }

  // What the ray hits first of the bodies, unless something fixed is before it.
  pick(ray) {
    const hit = pickBody(this.bodyView.views.values(), ray.origin, ray.direction);
    return hit !== null && this.sceneView.distance(ray.origin, ray.direction) < hit.distance ? null : hit;
  }

  // Draws when something looks different than before.
  draw(now) {
    const { model, bodyView, camera } = this;
    if (!this.framed && model.complete) this.frameAll();
    const before = this.tick;
    this.tick = this.player !== null ? this.player.advance(now)
      : this.clock.advance(now, { tickSeconds: model.tickSeconds, factor: model.realTimeFactor(), period: model.period });
    const timeMoves = this.tick !== before;
    if (this.tick < before) bodyView.unsettle();
    const bodiesMove = bodyView.update(this.tick, now);
    const moversMove = timeMoves && this.sceneView.update(this.tick * model.tickSeconds);
    if (!bodiesMove && !moversMove && !this.stale && !camera.moved) return false;
    this.stale = camera.moved = false;
    const selected = this.selected();
    this.overlays.setFrame(selected?.pose ?? null, selected === null ? null : extentOf(selected));
    camera.update();
    bodyView.pack(camera.planes(), camera.camera.position, camera.height / (2 * Math.tan(Math.PI / 8) * this.finePixels));
    this.renderer.render(this.scene, camera.camera);
    ++this.frames;
    for (const call of this.afterDraw.splice(0)) call();
    return true;
  }

  // So that most of the bodies are seen well; stragglers may be out of the picture.
  frameAll() {
    this.framed = true;
    const box = this.#middle();
    this.#layOut(box);
    const centre = box.getCenter(new THREE.Vector3());
    const size = box.getSize(new THREE.Vector3());
    const radius = Math.max(6, 0.46 * Math.hypot(size.x, size.z) + 0.25 * size.y);
    // A little above the middle of the picture: the tools are at its lower edge.
    this.camera.frame([centre.x, centre.y - 0.1 * radius, centre.z], radius);
  }

  #changed(body, before) {
    const moved = before >= 0 && before !== body.region;
    this.bodyView.changed(body, this.model.looks.get(body.id) ?? null, moved, performance.now());
  }

  #lost(body) {
    this.bodyView.lost(body);
    if (this.bodyView.selected === body.id) this.select(null);
  }

  // Of the bodies without the outermost twentieth on each side, and of what is fixed when that is not much larger.
  #middle() {
    const box = new THREE.Box3();
    const bodies = [...this.model.bodies.values()];
    const fixed = this.sceneView.bounds();
    if (bodies.length === 0) {
      if (!fixed.isEmpty()) return fixed;
      return box.set(new THREE.Vector3(-10, 0, -10), new THREE.Vector3(10, 5, 10));
    }
    for (const axis of [0, 1, 2]) {
      const values = bodies.map((b) => b.state.position[axis]).sort((a, b) => a - b);
      const cut = Math.floor(values.length * 0.05);
      box.min.setComponent(axis, values[cut] - 1);
      box.max.setComponent(axis, values[values.length - 1 - cut] + 1);
    }
    const size = (b) => b.getSize(new THREE.Vector3()).length();
    const both = fixed.isEmpty() ? box : box.clone().union(fixed);
    return size(both) < 2 * size(box) + 20 ? both : box;
  }

  // Ground and borders as large as the world seems to be.
  #layOut(box) {
    const { world } = this.model;
    if (world === null) return;
    const whole = box.clone();
    if (whole.isEmpty()) whole.set(new THREE.Vector3(-20, 0, -20), new THREE.Vector3(20, 5, 20));
    for (const rect of world.layout) {
      for (const [axis, edge] of [[0, rect.min_x], [0, rect.max_x], [2, rect.min_z], [2, rect.max_z]]) {
        if (Number.isFinite(edge)) whole.expandByPoint(whole.min.clone().setComponent(axis, edge));
      }
    }
    const size = whole.getSize(new THREE.Vector3());
    this.sceneView.set(world.scene, Math.max(60, groundReach * 0.5 * Math.max(size.x, size.z)));
    this.overlays.setBorders(world.layout, whole, this.sceneView.groundHeight() ?? whole.min.y, this.sceneView.uneven);
    this.stale = true;
  }
}
