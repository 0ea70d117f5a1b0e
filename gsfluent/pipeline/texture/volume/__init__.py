"""The voxels that get colours: domain, noise, colour spaces."""
