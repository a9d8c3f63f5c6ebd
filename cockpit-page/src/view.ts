// From metres to pixels of a map seen from above: x east to the right, y north upwards. Pure.

export interface View {
  /** The centre, east and north [m]. */
  east: number;
  north: number;
  /** Pixels per metre. */
  scale: number;
}

export interface Size {
  width: number;
  height: number;
}

export const toPixels = (view: View, size: Size, east: number, north: number): [number, number] => [
  size.width / 2 + (east - view.east) * view.scale,
  size.height / 2 - (north - view.north) * view.scale,
];

export const toMetres = (view: View, size: Size, x: number, y: number): [number, number] => [
  view.east + (x - size.width / 2) / view.scale,
  view.north - (y - size.height / 2) / view.scale,
];

/** A view of all places, with a margin; never of less than `least_m` metres. */
export function around(places: readonly (readonly [number, number, ...number[]])[], size: Size, least_m = 4): View | null {
  const first = places[0];
  if (!first) return null;
  let [west, east, south, north] = [first[0], first[0], first[1], first[1]];
  for (const [x, y] of places) {
    [west, east, south, north] = [Math.min(west, x), Math.max(east, x), Math.min(south, y), Math.max(north, y)];
  }
  const [wide, high] = [Math.max(least_m, (east - west) * 1.3), Math.max(least_m, (north - south) * 1.3)];
  return { east: (west + east) / 2, north: (south + north) / 2, scale: Math.min(size.width / wide, size.height / high) };
}

/** The difference between two views: the shift as a share of the smaller extent, or the logarithm of the zoom, if larger. */
export function apart(one: View, other: View, size: Size): number {
  const way_m = Math.hypot(one.east - other.east, one.north - other.north);
  const scale = Math.max(one.scale, other.scale);
  return Math.max((way_m * scale) / Math.min(size.width, size.height), Math.abs(Math.log(one.scale / other.scale)));
}

/** The distance between the lines of a grid: 1, 2 or 5 times a power of ten, at least `pixels` apart [m]. */
export function gridStep(scale: number, pixels = 45): number {
  const least = pixels / scale;
  const power = 10 ** Math.floor(Math.log10(least));
  return ([1, 2, 5, 10].find((factor) => factor * power >= least) ?? 10) * power;
}

/** Zoom about a point of the screen that keeps its place. */
export function zoomed(view: View, size: Size, factor: number, x: number, y: number): View {
  const [east, north] = toMetres(view, size, x, y);
  const scale = Math.max(0.5, Math.min(2000, view.scale * factor));
  const kept = { ...view, scale };
  const [there, up] = toMetres(kept, size, x, y);
  return { east: view.east + east - there, north: view.north + north - up, scale };
}
