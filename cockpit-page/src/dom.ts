// Small helpers for all panels. Unchanged values are not written, so that nothing is announced twice. Styles are classes
// and single properties: the page's policy forbids style attributes.

export type Tone = "ok" | "warn" | "bad" | "busy" | "quiet";
type Child = Node | string | null;
type Attributes = Record<string, string | number | boolean | ((event: never) => void)>;

/** An element: attributes by name, listeners as `onclick`, true and false for attributes without a value. */
export function h<Name extends keyof HTMLElementTagNameMap>(
  name: Name,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[Name] {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(key.slice(2), value as unknown as EventListener);
    else if (value === true) element.setAttribute(key, "");
    else if (value !== false) element.setAttribute(key, String(value));
  }
  element.append(...children.filter((child) => child !== null));
  return element;
}

export function svg<Name extends keyof SVGElementTagNameMap>(
  name: Name,
  attributes: Record<string, string | number> = {},
  ...children: (Node | string)[]
): SVGElementTagNameMap[Name] {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
  element.append(...children);
  return element;
}

export function setText(element: Element, text: string): void {
  if (element.textContent !== text) element.textContent = text;
}

export function setAttribute(element: Element, name: string, value: string): void {
  if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}

export const setTone = (element: Element, tone: Tone): void => setAttribute(element, "data-tone", tone);

export function setHidden(element: HTMLElement, hidden: boolean): void {
  if (element.hidden !== hidden) element.hidden = hidden;
}

export function setDisabled(element: HTMLButtonElement | HTMLInputElement | HTMLSelectElement, disabled: boolean): void {
  if (element.disabled !== disabled) element.disabled = disabled;
}

/** A colour of the style sheet, for canvases. */
export const colour = (name: string): string =>
  getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

let numbers = 0;

/** An id that no other element has. */
export function unique(prefix: string): string {
  numbers += 1;
  return `${prefix}-${numbers}`;
}

/** Size a canvas to its box in screen pixels; returns the screen pixels per CSS pixel. */
export function fit(canvas: HTMLCanvasElement): number {
  const density = Math.min(2, window.devicePixelRatio || 1);
  const [width, height] = [Math.round(canvas.clientWidth * density), Math.round(canvas.clientHeight * density)];
  if (canvas.width !== width) canvas.width = width;
  if (canvas.height !== height) canvas.height = height;
  return density;
}

/** Values that this browser remembers for the page; if storage is forbidden, none are. */
export const memory = {
  get(name: string): string | null {
    try {
      return localStorage.getItem(`skyloop-${name}`);
    } catch {
      return null;
    }
  },
  set(name: string, value: string): void {
    try {
      localStorage.setItem(`skyloop-${name}`, value);
    } catch {
      // as above
    }
  },
};
