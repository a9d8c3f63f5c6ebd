// Elements that must always be visible and pressable, such as the emergency stop. A modal dialog and a full screen put the
// rest of the page out of reach, so while one of them is open, these elements move into it.

const kept: HTMLElement[] = [];
/** The original place of each, while it is elsewhere. */
const homes = new Map<HTMLElement, Comment>();
/** The open dialogs and full screens; the newest holds the elements. */
const hosts: HTMLElement[] = [];

export function keepInReach(element: HTMLElement | null): void {
  if (element) kept.push(element);
}

/** Move the elements into a host, until `takeBack` or until another host takes them. */
export function lend(host: HTMLElement): void {
  hosts.push(host);
  arrange();
}

export function takeBack(host: HTMLElement): void {
  const place = hosts.indexOf(host);
  if (place >= 0) hosts.splice(place, 1);
  arrange();
}

function arrange(): void {
  const host = hosts.at(-1);
  for (const element of kept) {
    if (host && element.parentElement !== host) {
      if (!homes.has(element)) {
        homes.set(element, document.createComment(""));
        element.replaceWith(homes.get(element) as Comment);
      }
      host.append(element);
    } else if (!host) {
      homes.get(element)?.replaceWith(element);
      homes.delete(element);
    }
  }
}
