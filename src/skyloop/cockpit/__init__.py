"""The cockpit: a page from which a person watches, flies and understands every drone. Needs the extra ``cockpit``.

An application like any other, in a process of its own: ``skyloop cockpit`` or ``python -m skyloop.cockpit``. It
observes; a page that takes control gets a pilot's connection of its own for as long as it has it.

- ``server`` runs it, ``app`` and ``api`` have the routes; ``security`` decides which requests are answered, ``access``
  who asks (``peers``: whose program is at the other end of a loopback connection);
- ``finder`` finds proxies, ``fleet`` keeps a ``station`` for each drone, with what all its pages share: ``feeds``
  bring what the client delivers onto the event loop, ``telemetry``, ``values`` and ``alarms`` are the view model,
  ``overview`` one row of it, made at a ``beat``; ``stream`` sends, one object per open page;
- ``control`` flies for a page that took control, by ``orders``, with ``hands`` of its own; ``recordings`` records;
- ``testing`` is a page without a browser, ``child`` runs the cockpit beside a program;
- ``static`` is the page itself, built; nothing is fetched from elsewhere.
"""

from skyloop.cockpit.server import Access, serve_cockpit

__all__ = ["Access", "serve_cockpit"]
