"""``python -m benchmarks.loop``: the delays from a frame to its command, by stage; see ``measuring.loop``."""

if __name__ == "__main__":
    from benchmarks.command import main

    main("loop")
