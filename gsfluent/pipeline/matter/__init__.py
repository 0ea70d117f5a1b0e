"""Material points, their state, fields and fragments; the splats they carry."""
