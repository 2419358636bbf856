// Fetches the page again and replaces its live parts; without JavaScript the page reloads itself.
"use strict";

const EVERY_MS = 5000;

async function refresh() {
  const stale = document.getElementById("stale");
  try {
    const answer = await fetch(location.href, { cache: "no-store", signal: AbortSignal.timeout(EVERY_MS * 2) });
    if (!answer.ok) throw new Error(answer.status);
    const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
    document.title = fresh.title;
    for (const part of document.querySelectorAll("[data-live]")) {
      const next = fresh.getElementById(part.id);
      // Selected text stays, so that a command can be copied.
      const selected = !getSelection().isCollapsed && part.contains(getSelection().anchorNode);
      if (!next || selected || next.innerHTML === part.innerHTML) continue;
      const place = part.contains(document.activeElement) && document.activeElement.getAttribute("href");
      part.innerHTML = next.innerHTML;
      if (place) part.querySelector(`a[href="${CSS.escape(place)}"]`)?.focus({ preventScroll: true });
    }
    stale.hidden = true;
  } catch {
    stale.hidden = false;
  }
  setTimeout(refresh, EVERY_MS);
}

setTimeout(refresh, EVERY_MS);
