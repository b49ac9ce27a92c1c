"""One rigid workpiece: its mesh, its material, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from soma_bullet.assembly.decomposition import Decomposition, decompose
from soma_bullet.assembly.edges import Corners, Edges, convex_edges
from soma_bullet.assembly.facets import Facet, planar_facets
from soma_bullet.assembly.hulls import Hull
from soma_bullet.frames import Array, readonly


@dataclass(frozen=True, eq=False)
class Workpiece:
    """A rigid body to be placed.

    Attributes:
        name: unique in its assembly.
        vertices: (v, 3) [m], in the piece's own frame.
        faces: triangles (f, 3), outward by the right-hand rule.
        density: [kg/m3].
        friction: Coulomb coefficient against the other pieces and the support.
        clearance: how much every face of the real body stands back from the nominal mesh [m]; two pieces fit
            with a gap of twice that.
        chamfer: by how much the edges of the real body are cut, along both of their faces [m]. Mass and
            inertia are still those of the whole: what is missing is below one percent for chamfers up to a
            twentieth of a piece's thickness.
        color: red, green, blue in 0..1, for pictures.
    """

    name: str
    vertices: Array
    faces: Array
    density: float = 700.0
    friction: float = 0.5
    clearance: float = 1e-4
    color: tuple[float, float, float] = (0.7, 0.7, 0.7)
    chamfer: float = 0.0

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The nominal body as a trimesh."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    @cached_property
    def mass(self) -> float:
        """[kg]"""
        return self.density * float(self.mesh.volume)

    @cached_property
    def center_of_mass(self) -> Array:
        """(3,) [m] in the piece's frame, for a homogeneous body."""
        return readonly(self.mesh.center_mass)

    @cached_property
    def inertia(self) -> Array:
        """Inertia tensor (3, 3) [kg m2] about the centre of mass, in the piece's axes."""
        mesh = self.mesh.copy()
        mesh.density = self.density
        return readonly(mesh.moment_inertia)

    @cached_property
    def radius(self) -> float:
        """Largest distance of a vertex from the centre of mass [m]."""
        return float(np.linalg.norm(self.vertices - self.center_of_mass, axis=1).max())

    @cached_property
    def facets(self) -> tuple[Facet, ...]:
        """Planar faces in the piece's frame, largest first."""
        return planar_facets(self.vertices, self.faces)

    @cached_property
    def edges(self) -> tuple[Edges, Corners]:
        """Convex edges and corners of the surface, in the piece's frame."""
        return convex_edges(self.facets)

    @cached_property
    def decomposition(self) -> Decomposition:
        """How the nominal body is made of convex parts.

        Raises:
            NotDecomposableError: no decomposition is close enough.
        """
        return decompose(self.vertices, self.faces, self.facets)

    @cached_property
    def parts(self) -> tuple[Hull, ...]:
        """Convex polytopes in the piece's frame whose union is the nominal body."""
        return self.decomposition.parts

    @cached_property
    def roughness(self) -> float:
        """How far the parts may stand out of the body that is meant [m]: by its tessellation, and by its
        decomposition."""
        return max((facet.sagitta for facet in self.facets), default=0.0) + self.decomposition.deviation

    @cached_property
    def body_parts(self) -> tuple[Hull, ...]:
        """Convex polytopes of the real body: `parts` with every face of the body inset by the clearance;
        edges are whole."""
        return self.decomposition.inset(self.clearance)
