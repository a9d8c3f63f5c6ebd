"""The cockpit: a web page to watch, fly and understand every drone. Needs the extra ``cockpit``.

The cockpit is an application like any other, in its own process: ``skyloop cockpit`` or ``python -m skyloop.cockpit``.
The recorder only observes. A page has its own pilot connection for as long as it holds control.

- ``server`` runs the cockpit and ``listening`` accepts connections within limits; ``app`` and ``api`` hold the
  routes; ``security`` decides which requests are answered, ``access`` who sent them and what that person may do;
- ``discovery`` finds proxies; ``fleet`` keeps a ``station`` with the shared state of each drone, and lands and stops
  all drones; ``feeds`` bring the client's data onto the event loop; ``encoded_feed`` holds JPEG and H.264 pictures;
  ``telemetry`` is the view model; ``stream`` selects and sends, with one object per open socket;
- ``control_session`` flies for a page that has control, with ``commands``, over its own connection; ``takeover``
  handles requests for control;
- ``recordings`` records, replays and makes reports in a child process;
- ``testing`` is a page without a browser; ``child`` runs the cockpit next to a program;
- ``static`` is the built page; nothing is fetched from elsewhere.
"""

from skyloop.cockpit.server import Access, serve_cockpit, with_certificate

__all__ = ["Access", "serve_cockpit", "with_certificate"]
