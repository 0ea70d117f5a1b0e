"""What a crack leaves of splats: sites, faces, cuts, gaps; the Repair stage."""
