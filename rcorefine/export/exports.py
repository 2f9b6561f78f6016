"""Methods of a refinement that write it down for another program."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Any

from ..arguments import as_path
from ..systems.linear import Array
from ..writing import replacing
from .equations import equations_of
from .programs import PROGRAMS

if TYPE_CHECKING:
    from ..engine.structure import Structure

__all__ = ["CodeExports"]


class CodeExports:
    """Methods of `Refinement` that give its code."""

    __slots__ = ()

    if TYPE_CHECKING:
        parameters: tuple[Any, ...]

        def simulation_structure(self) -> tuple[Structure, Array, int]: ...  # noqa: D102

    def to_python(self, path: str | PathLike[str] | None = None) -> str:
        """Write the refined model as a file that python-control alone runs.

        Parameters
        ----------
        path : str or path, optional
            File to write.

        Returns
        -------
        str
            The code: `system`, a `control.NonlinearIOSystem` with every
            effect (and `linear`, a `control.StateSpace`, where all are
            linear); the estimates with their standard deviations stand in
            comments.

        Raises
        ------
        ModelError
            If an effect has no state equation (a delay: use `control.pade`), or the source of
            a law is not to be had.

        Notes
        -----
        It starts at rest unless told otherwise, as `control.input_output_response` does, which runs
        inputs along straight lines between samples.

        Examples
        --------
        >>> model, w = rco.mass_spring_damper(1.0, 0.8, 25.0), np.sin(0.3 * np.arange(200.0))
        >>> data = rco.Measurement(w, ct.forced_response(model.system.sample(0.05), U=w).outputs, dt=0.05)
        >>> better = rco.refine(model, data, [rco.Effect("stiffness", "link1")], offset=False)
        >>> space = {}
        >>> exec(better.to_python(), space)
        >>> bool(np.allclose(space["linear"].A, better.system.A))
        True
        """
        return self._program("Python", path)

    def to_c(self, path: str | PathLike[str] | None = None) -> str:
        """Write the refined model as functions in C99.

        Parameters
        ----------
        path : str or path, optional
            File to write.

        Returns
        -------
        str
            Functions ``NAME_rhs(t, x, u, dx)`` and ``NAME_output(t, x, u, y)``, sizes in an enumeration;
            the estimates with their standard deviations stand in comments.

        Raises
        ------
        ModelError
            As `to_python`, or a law holds what has no words in C here (it is named).

        Examples
        --------
        >>> model, w = rco.mass_spring_damper(1.0, 0.8, 25.0), np.sin(0.3 * np.arange(200.0))
        >>> data = rco.Measurement(w, ct.forced_response(model.system.sample(0.05), U=w).outputs, dt=0.05)
        >>> better = rco.refine(model, data, [rco.Effect("stiffness", "link1")], offset=False)
        >>> "void chain_rhs(double t" in better.to_c()
        True
        """
        return self._program("C", path)

    def to_matlab(self, path: str | PathLike[str] | None = None) -> str:
        """Write the refined model as a function of MATLAB or Octave.

        Parameters
        ----------
        path : str or path, optional
            File to write; MATLAB wants it to have the name of the function.

        Returns
        -------
        str
            Function ``[dx, y] = NAME(t, x, u)`` for `ode45`; the estimates with their standard deviations
            stand in comments.

        Raises
        ------
        ModelError
            As `to_c`.

        Examples
        --------
        >>> model, w = rco.mass_spring_damper(1.0, 0.8, 25.0), np.sin(0.3 * np.arange(200.0))
        >>> data = rco.Measurement(w, ct.forced_response(model.system.sample(0.05), U=w).outputs, dt=0.05)
        >>> better = rco.refine(model, data, [rco.Effect("stiffness", "link1")], offset=False)
        >>> better.to_matlab().splitlines()[0]
        'function [dx, y] = chain(t, x, u)'
        """
        return self._program("MATLAB", path)

    def to_modelica(self, path: str | PathLike[str] | None = None) -> str:
        """Write the refined model as a model in Modelica.

        Parameters
        ----------
        path : str or path, optional
            File to write.

        Returns
        -------
        str
            Model with inputs u, outputs y and states x from rest; the estimates with their standard
            deviations stand in comments.

        Raises
        ------
        ModelError
            As `to_c`.

        Examples
        --------
        >>> model, w = rco.mass_spring_damper(1.0, 0.8, 25.0), np.sin(0.3 * np.arange(200.0))
        >>> data = rco.Measurement(w, ct.forced_response(model.system.sample(0.05), U=w).outputs, dt=0.05)
        >>> better = rco.refine(model, data, [rco.Effect("stiffness", "link1")], offset=False)
        >>> better.to_modelica().splitlines()[0]
        'model chain'
        """
        return self._program("Modelica", path)

    def _program(self, language: str, path: str | PathLike[str] | None) -> str:
        target = None if path is None else as_path(path)
        structure, theta, _ = self.simulation_structure()
        remarks = [
            f"{row.name} at {row.place}: {row.value:.6g} +- {row.std:.2g} {row.unit}".rstrip()
            + (f" (was {row.initial:.6g})" if row.initial else "")
            for row in self.parameters
        ]
        text = PROGRAMS[language](equations_of(structure, theta, remarks))
        if target is not None:
            with replacing(target) as stream:
                stream.write(text.encode())
        return text
