"""Flies all drones that match, each by its own controller, all from this process, and prints how it went.

skyloop sim --drones 10 --name drone --world empty --option cameras=front --option width=64 --option fps=10
python scripts/swarm_flight.py "drone*" --seconds 60

Ends with 1 if a failsafe was missed when the drones were let go of in the air at the end.
"""

import argparse
import sys

from skyloop.bench.letting_go import fly, missed, report
from skyloop.cli.text import columns


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="+", help="names, patterns or addresses")
    parser.add_argument("--seconds", type=float, default=60.0)
    wanted = parser.parse_args()
    flights = fly(*wanted.targets, seconds=wanted.seconds)
    for line in columns(tuple(row) for row in report(flights)):
        print(line)
    unwanted = sum(flight.unwanted for flight in flights)
    print(f"{len(flights)} drones, {unwanted} unwanted failsafe steps, {len(missed(flights))} missed failsafes")
    return 1 if missed(flights) else 0


if __name__ == "__main__":
    sys.exit(main())
