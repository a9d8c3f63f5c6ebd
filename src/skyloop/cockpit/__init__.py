"""The cockpit: a page from which a person watches, flies and understands every drone. Needs the extra ``cockpit``.

An application like any other, in a process of its own: ``skyloop cockpit`` or ``python -m skyloop.cockpit``. It
observes; a page that takes control gets a pilot's connection of its own for as long as it has it.

- ``server`` runs it, ``listening`` takes connections while it has places; ``app`` and ``api`` have the routes;
  ``security`` decides which requests are answered, ``access`` who asks and what that person may do;
- ``discovery`` finds proxies; ``fleet`` keeps a ``station`` for each drone, with what its pages share, and lands and
  stops all drones; ``feeds`` bring what the client delivers onto the event loop, ``encoded_feed`` pictures and H.264 as
  it comes, of which ``page_stream`` chooses what a page gets; ``telemetry`` is the view model; ``stream`` sends, one
  object per open socket;
- ``control_session`` flies for a page that took control, by ``commands``, through a connection of its own;
  ``takeover`` is asking for control before it is taken;
- ``recordings`` records and replays; ``reports`` makes reports in a child process;
- ``testing`` is a page without a browser, ``child`` runs the cockpit beside a program;
- ``static`` is the page itself, built; nothing is fetched from elsewhere.
"""

from skyloop.cockpit.server import Access, serve_cockpit, with_certificate

__all__ = ["Access", "serve_cockpit", "with_certificate"]
