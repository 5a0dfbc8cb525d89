"""Work on data sets: tracking in this process, replay through a service, load on a service, and several processes."""
