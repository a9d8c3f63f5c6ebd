"""Live viewers: what a recorder would write to a file is shown by Foxglove or Rerun while it happens.

- ``view`` subscribes to what its ``Screen`` wants, and hands it the samples on a thread of its own;
- ``foxglove_server`` is a screen: a WebSocket server with the topics and schemas of recordings, which ``topics`` lists;
  ``parameters`` reads and writes the drones' parameters for it;
- ``rerun_viewer`` is another, of what :mod:`skyloop.recording.rerun_log` draws.
"""
