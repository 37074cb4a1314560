// The page: what comes in goes to the view, what the user does goes out.
import tables from 'virtual:field-tables';
import { Chart } from './charts.js';
import { exposeDebug } from './debug.js';
import { Live } from './live.js';
import { Rate } from './model.js';
import { byId, clockText, setText, showBanner, showBody, showRegions, toast } from './panels.js';
import { Player } from './player.js';
import { readRecording } from './recording.js';
import { Tools } from './tools.js';
import { View } from './view.js';
import { Messages } from './wire.js';

const textMs = 200;  // between changes of the text
const speeds = [0.25, 0.5, 1, 2, 4];

const messages = new Messages(tables);
const view = new View(byId('view'));
const { model } = view;
const state = {
  live: null,          // Live
  connected: false,
  reason: '',          // why it is not
  downs: new Map(),    // region -> why it is not connected
  follow: false,
  followed: [0, 0, 0], // where the followed body was
  framesPerSecond: 0,
  highlightMs: 0,      // from the last click to its picture
  outcomes: [],        // of pushes, the latest last
  toggles: { borders: true, auras: false, flashes: false, charts: true },
  recordingName: '',
};
const rates = [];

const charts = {
  frame: new Chart(byId('charts'), 'frame time', {
    format: (v) => `${v.toFixed(1)} ms`, floor: 4, hint: 'CPU time of a tick on each region server',
  }),
  factor: new Chart(byId('charts'), 'speed', {
    format: (v) => `${v.toFixed(2)}×`, floor: 1.1, ceiling: 1.5, hint: 'Simulated time per wall time of each region',
  }),
  traffic: new Chart(byId('charts'), 'replicas', {
    format: (v) => `${v.toFixed(0)} kbit/s`, floor: 100, hint: 'What each region sends to this page',
  }),
};

// ---- live ----

function connectionText() {
  if (model.world === null) return state.reason === '' ? '' : `no world yet, trying: ${state.reason}`;
  if (!state.connected) return `connection lost, trying again: ${state.reason}`;
  if (state.downs.size === 0) return '';
  const [region, reason] = [...state.downs][0];
  const which = state.downs.size === model.members.length ? 'all regions' : `region ${[...state.downs.keys()].sort().join(', ')}`;
  return `connection lost to ${which}, trying again: ${reason || `region ${region} is gone`}`;
}

function takeStatus(region, status) {
  model.stream(region).status = status;
  const now = performance.now();
  charts.frame.add(region, now, status.frame_mean_ms);
  charts.factor.add(region, now, status.real_time_factor);
  if (state.toggles.auras) view.overlays.setAuras(region, status.aura);
  view.stale ||= state.toggles.auras;
}

const liveEvents = {
  world(world) {
    state.downs.clear();
    // After a lost connection to the gateway the bodies stay until the new streams have told all.
    const same = model.world?.name === world.name && model.world.endpoints.join() === world.endpoints.join();
    if (same) return;
    model.setWorld(world);
    view.setWorld();
    clearCharts();
  },
  layout(world, ended) {
    for (const region of ended) {
      state.downs.delete(region);
      view.overlays.setAuras(region, []);
    }
    model.setLayout(world);
    view.setLayout();
  },
  begin(region) {
    state.downs.delete(region);
    model.beginStream(region);
  },
  frame(region, frame, bytes) {
    // The run was started anew: nothing of the old one counts. A server that was replaced goes back alone.
    const others = model.streams.some((stream, other) => other !== region && stream.up);
    if (frame.base_tick === 0 && frame.tick < model.stream(region).tick && !others) {
      model.setWorld(model.world);
      view.setWorld();
      for (const other of model.members) model.beginStream(other);
    }
    model.takeFrame(region, frame, bytes);
    view.clock.take(frame.tick, performance.now());
  },
  status: takeStatus,
  link(region, up, text) {
    if (up || !model.members.includes(region)) return;
    state.downs.set(region, text);
    model.stream(region).up = false;
  },
  connection(up, text) {
    state.connected = up;
    state.reason = text;
    if (!up) model.streams.forEach((stream) => (stream.up = false));
  },
  // A world that is known stays; its regions say themselves that they are gone.
  waiting: (text) => (state.reason = text),
  outcome(outcome) {
    state.outcomes.push(outcome);
    if (state.outcomes.length > 100) state.outcomes.shift();
    if (outcome.reason !== '') toast(`the push did not act: ${outcome.reason}`);
  },
  error: (text) => toast(text),
};

function goLive() {
  leaveRecording();
  state.live?.close();
  model.setWorld(null);
  state.live = new Live(messages, liveEvents);
  state.live.setAuras(state.toggles.auras);
}

// ---- recordings ----

async function openRecording(name, file) {
  try {
    const showProgress = (share) => setText(byId('mode'), `reading ${Math.round(share * 100)} %`);
    const recording = await readRecording(file, messages, showProgress);
    state.live?.close();
    state.live = null;
    showBanner('');
    view.player = new Player(model, messages, recording);
    view.player.onStatus = takeStatus;
    state.recordingName = name;
    state.downs.clear();
    view.setWorld();
    clearCharts();
    setTool('look');
  } catch (error) {
    toast(error.message);
  }
  byId('recordings').close();
  showTime();
}

function leaveRecording() {
  view.player = null;
  state.recordingName = '';
  showTime();
}

async function fetchRecording(name) {
  const response = await fetch(`recordings/${encodeURIComponent(name)}`);
  if (!response.ok) return toast(`${name}: ${await response.text()}`);
  return openRecording(name, await response.arrayBuffer());
}

async function settings() {
  try {
    return await (await fetch('settings.json')).json();
  } catch {
    return { live: true, recordings: [] };
  }
}

async function showRecordings() {
  const { recordings } = await settings();
  const list = byId('recording-list');
  list.replaceChildren(...recordings.map(({ name, bytes }) => {
    const item = document.createElement('li');
    const button = document.createElement('button');
    button.type = 'button';
    button.textContent = `${name} (${(bytes / 1e6).toFixed(1)} MB)`;
    button.addEventListener('click', () => fetchRecording(name));
    item.append(button);
    return item;
  }));
  if (recordings.length === 0) list.textContent = 'The gateway has none; see its flag --recordings.';
  byId('recordings').showModal();
}

function showTime() {
  const { player } = view;
  byId('time').hidden = player === null;
  const acts = 'button[data-tool="push"], button[data-tool="spawn"], #remove';
  for (const button of document.querySelectorAll(acts)) button.disabled = player !== null;
  if (player === null) return;
  const { firstTick, lastTick } = player.recording;
  const scrub = byId('scrub');
  scrub.min = String(firstTick);
  scrub.max = String(lastTick);
  if (document.activeElement !== scrub || player.playing) scrub.value = String(player.tick);
  setText(byId('time-text'), clockText(player.tick * model.tickSeconds));
  setText(byId('time-end'), clockText(lastTick * model.tickSeconds));
  setText(byId('play'), player.playing ? 'pause' : 'play');
  byId('speed').value = String(player.speed);
}

function togglePlaying() {
  const { player } = view;
  if (player === null) return;
  if (!player.playing && player.tick >= player.recording.lastTick) player.seek(player.recording.firstTick);
  player.playing = !player.playing;
  showTime();
}

function seek(tick) {
  view.player?.seek(tick);
  clearCharts();
  showTime();
}

function changeSpeed(step) {
  const { player } = view;
  if (player === null) return;
  const at = Math.min(speeds.length - 1, Math.max(0, speeds.indexOf(player.speed) + step));
  player.speed = speeds[at];
  showTime();
}

// ---- what the user does ----

function clearCharts() {
  for (const chart of Object.values(charts)) chart.clear();
  rates.length = 0;
}

function select(id, event = null) {
  state.follow = false;
  view.select(id);
  showBody(view.selected());
  if (id === null || event === null) return;
  // When the picture has been drawn, and the next one is asked for.
  view.afterDraw.push(() => requestAnimationFrame(() => (state.highlightMs = performance.now() - event.timeStamp)));
}

async function castRay(ray) {
  try {
    const { hit } = await state.live.call({ type: 'ray', origin: ray.origin, direction: ray.direction, length: 2000 });
    return hit === null ? null : [hit.point.x, hit.point.y, hit.point.z];
  } catch (error) {
    toast(error.message);
    return null;
  }
}

async function spawn(message) {
  try {
    const { bodies, rejected } = await state.live.call({ type: 'spawn', ...message });
    if (rejected.length > 0) toast(`not added: ${rejected[0].reason}`);
    return bodies;
  } catch (error) {
    toast(`not added: ${error.message}`);
    return [];
  }
}

async function removeSelected() {
  const selected = view.selected();
  if (selected === null || state.live === null) return;
  try {
    const { removed, rejected } = await state.live.call({ type: 'remove', bodies: [String(selected.body.id)] });
    if (removed === 0) toast(`not removed: ${rejected[0]?.reason ?? 'it is gone'}`);
  } catch (error) {
    toast(`not removed: ${error.message}`);
  }
}

const tools = new Tools(byId('view'), view.camera, {
  pick: (ray) => view.pick(ray),
  select,
  push: (message) => state.live?.send({ type: 'push', ...message }) || toast('there is no connection'),
  spawn,
  castRay,
  arrow(from, to) {
    view.overlays.setArrow(from, to);
    view.stale = true;
  },
  redraw: () => (view.stale = true),
  live: () => state.live !== null,
});

function setTool(tool) {
  if (tool !== 'look' && view.player !== null) return;
  if (tool === 'spawn' && tools.tool === 'spawn') {
    tools.shape = tools.shape === 'sphere' ? 'box' : 'sphere';
    setText(byId('shape'), tools.shape);
  }
  tools.setTool(tool);
  for (const button of document.querySelectorAll('[data-tool]')) {
    if (button.tagName === 'BUTTON') button.setAttribute('aria-pressed', String(button.dataset.tool === tool));
  }
}

function setToggle(name, on) {
  state.toggles[name] = on;
  document.querySelector(`[data-toggle="${name}"]`).setAttribute('aria-pressed', String(on));
  view.overlays.borders.visible = state.toggles.borders;
  view.overlays.auras.visible = state.toggles.auras;
  view.bodyView.flashes = state.toggles.flashes;
  byId('charts').hidden = !state.toggles.charts;
  if (name === 'auras') {
    state.live?.setAuras(on);
    view.overlays.clearAuras();
  }
  view.stale = true;
}

function follow() {
  const selected = view.selected();
  if (selected === null) return view.frameAll();
  state.follow = !state.follow;
  state.followed = selected.pose.slice(0, 3);
  if (state.follow) view.camera.frame(state.followed, Math.max(4, 4 * selected.reach));
}

// The camera goes with the followed body.
function moveAlong() {
  const selected = view.selected();
  if (!state.follow || selected === null) return;
  const moved = selected.pose.slice(0, 3).map((v, i) => v - state.followed[i]);
  if (moved.every((v) => v === 0)) return;
  state.followed = selected.pose.slice(0, 3);
  const { target } = view.camera;
  target.set(target.x + moved[0], target.y + moved[1], target.z + moved[2]);
  view.camera.moved = true;
}

const keys = {
  1: () => setTool('look'),
  2: () => setTool('push'),
  3: () => setTool('spawn'),
  f: follow,
  r: () => setToggle('borders', !state.toggles.borders),
  a: () => setToggle('auras', !state.toggles.auras),
  o: () => setToggle('flashes', !state.toggles.flashes),
  c: () => setToggle('charts', !state.toggles.charts),
  l: showRecordings,
  '?': () => byId('help').showModal(),
  Escape: () => select(null),
  Delete: removeSelected,
  ' ': togglePlaying,
  ArrowLeft: () => seek(view.player.tick - 1 / model.tickSeconds),
  ArrowRight: () => seek(view.player.tick + 1 / model.tickSeconds),
  '-': () => changeSpeed(-1),
  '+': () => changeSpeed(1),
  '=': () => changeSpeed(1),
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector('dialog[open]')) return;
  const { target } = event;
  const ownKeys = target.matches('input, select') || (target.matches('button') && event.key === ' ');
  const action = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (ownKeys || action === undefined || (event.key.startsWith('Arrow') && view.player === null)) return;
  event.preventDefault();
  action();
}

function listen() {
  document.addEventListener('keydown', onKey);
  for (const button of document.querySelectorAll('button[data-tool]')) {
    button.addEventListener('click', () => setTool(button.dataset.tool));
  }
  for (const button of document.querySelectorAll('[data-toggle]')) {
    button.addEventListener('click', () => setToggle(button.dataset.toggle, !state.toggles[button.dataset.toggle]));
  }
  for (const button of document.querySelectorAll('[data-close]')) {
    button.addEventListener('click', () => button.closest('dialog').close());
  }
  byId('follow').addEventListener('click', follow);
  byId('remove').addEventListener('click', removeSelected);
  byId('open').addEventListener('click', showRecordings);
  byId('help-button').addEventListener('click', () => byId('help').showModal());
  byId('play').addEventListener('click', togglePlaying);
  byId('leave').addEventListener('click', goLive);
  byId('scrub').addEventListener('input', () => seek(Number(byId('scrub').value)));
  byId('speed').addEventListener('change', () => view.player && (view.player.speed = Number(byId('speed').value)));
  byId('file').addEventListener('change', async () => {
    const [file] = byId('file').files;
    if (file) await openRecording(file.name, await file.arrayBuffer());
    byId('file').value = '';
  });
}

// ---- text, a few times a second ----

let textAt = 0, framesAt = 0;

function modeText() {
  if (view.player !== null) return `recording ${state.recordingName}${view.player.seeking ? ', seeking' : ''}`;
  if (model.world === null) return 'connecting';
  return state.connected && state.downs.size === 0 ? 'live' : 'connection lost';
}

function showText(now) {
  state.framesPerSecond = ((view.frames - framesAt) * 1000) / (now - textAt);
  framesAt = view.frames;
  textAt = now;
  const { bodies, asleep } = model.counts();
  const seconds = view.tick * model.tickSeconds;
  setText(byId('world-name'), model.world?.name ?? 'Aureole');
  setText(byId('mode'), modeText());
  const text = [
    `bodies ${bodies}`, `asleep ${asleep}`, `tick ${Math.floor(view.tick)}`, clockText(seconds),
    `speed ${model.realTimeFactor().toFixed(2)}`, `${state.framesPerSecond.toFixed(0)} frames/s`,
  ];
  setText(byId('counts'), model.world === null ? '' : text.join(' · '));
  showBanner(view.player === null ? connectionText() : '');
  showRegionCounts();
  showBody(view.selected());
  drawCharts(now);
  if (view.player !== null) showTime();
}

function showRegionCounts() {
  const owned = new Array(model.regions).fill(0);
  for (const body of model.bodies.values()) ++owned[body.region];
  const { members } = model;
  showRegions(owned.map((bodies, region) => ({
    bodies, there: members.includes(region), up: view.player !== null || model.streams[region]?.up === true,
  })));
}

function drawCharts(now) {
  model.streams.forEach((stream, region) => {
    const rate = (rates[region] ??= new Rate());
    rate.add(now, stream.bytes);
    if (view.player === null) charts.traffic.add(region, now, rate.perSecond() * 8e-3);
    if (stream.status === null && stream.complete) charts.factor.add(region, now, stream.realTimeFactor);
  });
  if (state.toggles.charts) for (const chart of Object.values(charts)) chart.draw(now);
}

function animate(now) {
  requestAnimationFrame(animate);
  moveAlong();
  view.draw(now);
  if (now - textAt >= textMs) showText(now);
}

listen();
setTool('look');
exposeDebug({ state, view, model, seek, spawn, select: (id) => select(id === null ? null : BigInt(id)) });
requestAnimationFrame(animate);
const { live, recordings } = await settings();
const wanted = new URLSearchParams(window.location.search).get('recording');
if (wanted !== null) await fetchRecording(wanted);
if (view.player !== null) showTime();
else if (live) goLive();
else if (recordings.length > 0) await showRecordings();
