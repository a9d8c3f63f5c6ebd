"""The cockpit: a page on loopback from which a person watches a drone. Needs the extra ``cockpit``.

An observer application like any other, in a process of its own: ``python -m skyloop.cockpit NAME``.

- ``server`` runs it, ``app`` has the routes, ``security`` decides who may ask;
- ``feeds`` bring what the client delivers onto the event loop, ``telemetry`` is the view model, ``stream`` the senders,
  one per open page;
- ``static`` is the page: plain HTML, CSS and JavaScript modules, nothing fetched from elsewhere.
"""

from skyloop.cockpit.server import serve_cockpit

__all__ = ["serve_cockpit"]
