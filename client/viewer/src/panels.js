// The text around the view: status, the selected body, messages.
import { cssColour, regionColour } from './palette.js';
import { describeShape } from './shapes.js';

export const byId = (id) => document.getElementById(id);

// Sets the text only when it is another one: the browser lays out anew each time.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

const metres = (v) => v.map((x) => x.toFixed(2)).join(', ');

// Rows of [name, value] of a body.
export function bodyRows(view) {
  const { body, look } = view;
  const { state } = body;
  const speed = state.velocity === null ? null : Math.hypot(...state.velocity);
  return [
    ['region', String(body.region)],
    ['epoch', String(state.epoch)],
    ['mass', look ? `${Number(look.mass.toPrecision(4))} kg` : 'unknown'],
    ['shape', look ? describeShape(look.shape) : 'unknown'],
    ['position', `${metres(state.position)} m`],
    ['velocity', speed === null ? 'not told' : `${metres(state.velocity)} m/s`],
    ['speed', speed === null ? 'not told' : `${speed.toFixed(2)} m/s`],
    ['state', state.asleep ? 'asleep' : 'awake'],
  ];
}

// `view`: of BodyView; null hides the panel.
export function showBody(view) {
  const panel = byId('body');
  panel.hidden = view === null;
  if (view === null) return;
  setText(byId('body-id'), `body ${view.body.id}`);
  byId('body-region').style.background = cssColour(regionColour(view.body.region));
  const list = byId('body-rows');
  const rows = bodyRows(view);
  while (list.children.length < 2 * rows.length) {
    list.append(document.createElement(list.children.length % 2 === 0 ? 'dt' : 'dd'));
  }
  rows.forEach(([name, value], i) => {
    setText(list.children[2 * i], name);
    setText(list.children[2 * i + 1], value);
  });
}

// A square and a number per region that is there; those that are not connected are crossed out.
export function showRegions(regions) {
  const list = byId('regions');
  while (list.children.length > regions.length) list.lastChild.remove();
  while (list.children.length < regions.length) {
    const item = document.createElement('li');
    const square = document.createElement('i');
    square.style.background = cssColour(regionColour(list.children.length));
    item.append(square, document.createElement('span'));
    list.append(item);
  }
  regions.forEach(({ bodies, there, up }, region) => {
    const item = list.children[region];
    item.hidden = !there;
    item.className = up ? '' : 'lost';
    item.title = up ? `region ${region}: ${bodies} bodies` : `region ${region}: not connected`;
    setText(item.lastChild, `${region}: ${bodies}`);
  });
}

let toastTimer = 0;

// A message that goes away by itself.
export function toast(text) {
  const element = byId('toast');
  setText(element, text);
  element.hidden = false;
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => (element.hidden = true), 4000);
}

export function showBanner(text) {
  byId('banner').hidden = text === '';
  setText(byId('banner'), text);
}

// "1:02.5" of seconds.
export function clockText(seconds) {
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(1).padStart(4, '0')}`;
}
