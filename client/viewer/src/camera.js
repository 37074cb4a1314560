// A camera that goes around a point.
import * as THREE from 'three';

const closest = 0.5, furthest = 3000;  // m
const steepest = 1.5;  // rad
const fieldOfView = 45;  // degrees, from top to bottom

export class OrbitCamera {
  constructor() {
    this.camera = new THREE.PerspectiveCamera(fieldOfView, 1, 0.1, 5000);
    this.target = new THREE.Vector3();
    this.yaw = 0.65;
    this.pitch = 0.58;
    this.distance = 50;
    this.moved = true;
  }

  resize(width, height) {
    this.width = width;
    this.height = height;
    this.camera.aspect = width / height;
    this.moved = true;
  }

  orbit(dx, dy) {
    this.yaw -= dx * 0.006;
    this.pitch = Math.min(steepest, Math.max(-steepest, this.pitch + dy * 0.006));
    this.moved = true;
  }

  // By pixels: what is at the target's distance follows the pointer.
  pan(dx, dy) {
    const perPixel = (2 * this.distance * Math.tan((fieldOfView * Math.PI) / 360)) / this.height;
    const e = this.camera.matrixWorld.elements;
    for (const [axis, amount] of [[0, -dx * perPixel], [4, dy * perPixel]]) {
      this.target.x += e[axis] * amount;
      this.target.y += e[axis + 1] * amount;
      this.target.z += e[axis + 2] * amount;
    }
    this.moved = true;
  }

  zoom(factor) {
    this.distance = Math.min(furthest, Math.max(closest, this.distance * factor));
    this.moved = true;
  }

  // So that a sphere of this radius fills the view.
  frame(centre, radius) {
    this.target.set(...centre);
    const narrow = Math.min(1, this.camera.aspect);
    this.distance = Math.min(furthest, Math.max(4 * closest, radius / (Math.sin((fieldOfView * Math.PI) / 360) * narrow)));
    this.moved = true;
  }

  // Before drawing and before rays are made.
  update() {
    const { yaw, pitch, distance, target, camera } = this;
    const flat = Math.cos(pitch) * distance;
    camera.position.set(target.x + Math.sin(yaw) * flat, target.y + Math.sin(pitch) * distance, target.z + Math.cos(yaw) * flat);
    camera.lookAt(target);
    camera.near = Math.max(0.05, distance / 500);
    camera.far = Math.max(1500, distance * 8);
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
  }

  // Through a place of the canvas, in pixels: { origin, direction } as arrays; the direction has length 1.
  ray(x, y) {
    const point = new THREE.Vector3((2 * x) / this.width - 1, 1 - (2 * y) / this.height, 0.5).unproject(this.camera);
    const direction = point.sub(this.camera.position).normalize();
    return { origin: this.camera.position.toArray(), direction: direction.toArray() };
  }

  // The sides of what it sees, four numbers each: a normal that points inwards, and an offset.
  planes() {
    const matrix = new THREE.Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
    // Without the far one.
    const { planes } = new THREE.Frustum().setFromProjectionMatrix(matrix);
    return planes.slice(0, 4).flatMap((p) => [...p.normal.toArray(), p.constant]);
  }

  // Where the camera looks; length 1.
  forward() {
    return this.camera.getWorldDirection(new THREE.Vector3()).toArray();
  }

  // Where a point of the world is on the canvas, in pixels; null when it is behind.
  project(position) {
    const p = new THREE.Vector3(...position).project(this.camera);
    return p.z > 1 ? null : { x: ((p.x + 1) / 2) * this.width, y: ((1 - p.y) / 2) * this.height };
  }
}
