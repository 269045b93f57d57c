"""Quality of meshes: shapes of tetrahedra, topology, and checks that a finite-element solver can use them."""
