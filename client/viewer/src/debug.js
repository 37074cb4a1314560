// window.aureole: what tests, and curious people in the console, can ask the page.

export function exposeDebug({ state, view, model, seek, spawn, select }) {
  const bodyOf = (id) => {
    const shown = view.bodyView.views.get(BigInt(id));
    if (shown === undefined) return null;
    const { body } = shown;
    return {
      id: String(body.id), region: body.region, epoch: body.state.epoch, asleep: body.state.asleep, tick: body.tick,
      position: [...body.state.position], shown: shown.pose.slice(0, 3), velocity: body.state.velocity,
      mass: shown.look?.mass ?? 0, colour: view.bodyView.colourOf(body.id),
    };
  };
  window.aureole = {
    ready: () => model.complete && view.framed,
    counts: () => ({ ...model.counts(), drawn: view.bodyView.views.size, regions: model.members.length }),
    members: () => model.members,
    tick: () => view.tick,
    newest: () => model.newest,
    ids: () => [...model.bodies.keys()].map(String),
    body: bodyOf,
    screen: (id) => {
      const shown = view.bodyView.views.get(BigInt(id));
      return shown === undefined ? null : view.camera.project(shown.pose);
    },
    // The body that a click there would hit.
    at: (x, y) => {
      const hit = view.pick(view.camera.ray(x, y));
      return hit === null ? null : String(hit.body.body.id);
    },
    selected: () => (view.bodyView.selected === null ? null : String(view.bodyView.selected)),
    highlightMs: () => state.highlightMs,
    frames: () => view.frames,
    framesPerSecond: () => state.framesPerSecond,
    outcomes: () => state.outcomes,
    setPixelRatio: (ratio) => view.setPixelRatio(ratio),
    connected: () => state.connected && state.downs.size === 0,
    look: (target, distance, yaw, pitch) => {
      view.camera.target.set(...target);
      Object.assign(view.camera, { distance, yaw, pitch, moved: true });
      view.camera.update();
    },
    playing: () => view.player?.playing ?? false,
    pause: () => view.player && (view.player.playing = false),
    seek,
    seeking: () => view.player?.seeking ?? false,
    span: () => view.player && [view.player.recording.firstTick, view.player.recording.lastTick],
    spawn,
    select,
    send: (message) => state.live?.send(message),
    call: (message) => state.live.call(message),
  };
}
