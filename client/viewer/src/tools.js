// What the pointer does: look around, select, push, throw, drop bodies.

const clickPixels = 4;
const pushSpeed = 6;     // m/s, that a push gives a body
const throwFactor = 2.5; // m/s per metre of drag
const fastestThrow = 40; // m/s
const dropHeight = 1.5;  // m, over what is under the pointer
const farDrop = 25;      // m, when nothing is

const add = (a, b, s) => a.map((v, i) => v + b[i] * s);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export class Tools {
  // `app`: pick(ray), select(id, event), push(message), spawn(message), castRay(ray), arrow(from, to), redraw(), live().
  constructor(canvas, camera, app) {
    Object.assign(this, { canvas, camera, app });
    this.tool = 'look';
    this.shape = 'sphere';
    this.drag = null;
    canvas.addEventListener('pointerdown', (event) => this.#down(event));
    canvas.addEventListener('pointermove', (event) => this.#move(event));
    canvas.addEventListener('pointerup', (event) => this.#up(event));
    canvas.addEventListener('pointercancel', () => this.#cancel());
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === 1 ? 24 : 1);
      camera.zoom(Math.exp(Math.max(-400, Math.min(400, pixels)) * 0.0012));
      app.redraw();
    }, { passive: false });
  }

  setTool(tool) {
    this.tool = tool;
    this.#cancel();
    this.canvas.dataset.tool = tool;
  }

  #down(event) {
    if (this.drag !== null) return;
    this.canvas.setPointerCapture(event.pointerId);
    const pans = event.button !== 0 || event.shiftKey || event.ctrlKey;
    const { offsetX: x, offsetY: y } = event;
    const drag = { pointer: event.pointerId, x, y, fromX: x, fromY: y, moved: false, pans, hit: null };
    if (!pans && this.tool === 'push' && this.app.live()) {
      const ray = this.camera.ray(event.offsetX, event.offsetY);
      const hit = this.app.pick(ray);
      // It is thrown along the plane through this point that faces the camera.
      if (hit !== null) Object.assign(drag, { hit, ray, start: add(ray.origin, ray.direction, hit.distance) });
    }
    this.drag = drag;
  }

  #move(event) {
    const drag = this.drag;
    if (drag === null || event.pointerId !== drag.pointer) return;
    const dx = event.offsetX - drag.x, dy = event.offsetY - drag.y;
    drag.moved ||= Math.hypot(event.offsetX - drag.fromX, event.offsetY - drag.fromY) > clickPixels;
    if (!drag.moved) return;
    drag.x = event.offsetX;
    drag.y = event.offsetY;
    if (drag.hit !== null) this.app.arrow(drag.start, this.#onPlane(drag));
    else if (drag.pans) this.camera.pan(dx, dy);
    else this.camera.orbit(dx, dy);
    this.app.redraw();
  }

  #up(event) {
    const drag = this.drag;
    if (drag === null || event.pointerId !== drag.pointer) return;
    this.#cancel();
    if (drag.moved && drag.hit !== null) this.#throw(drag);
    else if (!drag.moved && !drag.pans) this.#click(drag, event);
  }

  #cancel() {
    this.drag = null;
    this.app.arrow(null, null);
  }

  #onPlane(drag) {
    const ray = this.camera.ray(drag.x, drag.y), facing = this.camera.forward();
    const distance = dot(add(drag.start, ray.origin, -1), facing) / dot(ray.direction, facing);
    return add(ray.origin, ray.direction, distance);
  }

  #throw(drag) {
    const way = add(this.#onPlane(drag), drag.start, -1);
    const speed = Math.hypot(...way) * throwFactor;
    const scale = speed > fastestThrow ? (throwFactor * fastestThrow) / speed : throwFactor;
    const id = drag.hit.body.body.id;
    this.app.select(id, null);
    this.app.push({ body: String(id), velocity_change: way.map((v) => v * scale) });
  }

  #click(drag, event) {
    const ray = drag.ray ?? this.camera.ray(drag.x, drag.y);
    if (this.tool === 'spawn' && this.app.live()) return this.#drop(ray);
    const hit = drag.hit ?? this.app.pick(ray);
    this.app.select(hit === null ? null : hit.body.body.id, event);
    if (hit !== null && this.tool === 'push' && this.app.live()) this.#push(hit, ray);
  }

  // At the point that was clicked, so that it turns as well.
  #push(hit, ray) {
    const { body, look } = hit.body;
    const mass = look?.mass ?? 0;
    const push = { body: String(body.id) };
    if (mass > 0) {
      push.impulse = ray.direction.map((v) => v * mass * pushSpeed);
      push.at_body_point = hit.point;
    } else {
      push.velocity_change = ray.direction.map((v) => v * pushSpeed);
    }
    this.app.push(push);
  }

  async #drop(ray) {
    const hit = await this.app.castRay(ray);
    const at = hit === null ? add(ray.origin, ray.direction, farDrop) : hit;
    const position = [at[0], at[1] + dropHeight, at[2]];
    const shape = this.shape === 'box' ? { box: { size: [0.8, 0.8, 0.8] } } : { sphere: { radius: 0.45 } };
    this.app.spawn({ bodies: [{ shape, position }] });
  }
}
