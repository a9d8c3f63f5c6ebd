"""Wire formats of the Parrot AR.Drone 1 and 2: AT commands, navdata, configuration and video."""
