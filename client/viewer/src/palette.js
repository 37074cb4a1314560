// Colours, as red, green, blue from 0 to 1 in sRGB.

// Of regions: a set that people who see no red or no green can tell apart as well (after Okabe and Ito), made for a
// dark ground. From the ninth region on they come again, lighter.
const regions = ['#e69f00', '#56b4e9', '#00b487', '#e8dc4a', '#4a7fe0', '#e0692b', '#cc79a7', '#b8bcc4'];

export const unowned = [0.5, 0.5, 0.5];
export const highlight = [1, 1, 1];

function parse(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
}

const parsed = regions.map(parse);

export function regionColour(region) {
  if (region < 0) return unowned;
  const base = parsed[region % parsed.length];
  const lighter = Math.min(0.6, 0.35 * Math.floor(region / parsed.length));
  return base.map((c) => c + (1 - c) * lighter);
}

export function cssColour(colour) {
  return `rgb(${colour.map((c) => Math.round(c * 255)).join(' ')})`;
}

// Of a body: its owner's, dimmed while it sleeps, white for a moment when its owner has changed (flash from 1 to 0).
export function bodyColour(region, asleep, flash = 0) {
  const share = asleep ? 0.48 : 1;
  return regionColour(region).map((c) => c * share + (1 - c * share) * flash);
}
