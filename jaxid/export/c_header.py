"""A C header with the torques that a motion needs: single precision, without allocation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from jaxid.export.exported import ExportedFile
from jaxid.export.laws import Language, written
from jaxid.export.plain import PlainTree, identifier

_C = {"exp": "expf", "cos": "cosf", "fabs": "fabsf"}

_HEADER = """\
/* Forces that the joints of {title} need for a motion, and the commands of their drives.
 *
 * Written by jaxid {version} from a result. Single precision, no allocation, no state; C99 or C++.
 * Joints: {joints}.
 * Units: rad, m, s, N m, N; commands in the unit of the log.
{remarks} *
 * Dry friction takes its sign from v, linear within {NAME}_SIGN_WIDTH: give the wanted velocities.
 */
#ifndef {NAME}_H
#define {NAME}_H

#include <math.h>

#ifndef {NAME}_SIGN_WIDTH
#define {NAME}_SIGN_WIDTH 1e-3f
#endif
#define {NAME}_JOINTS {joint_count}
#define {NAME}_DRIVES {drive_count}
#define {NAME}_LINKS {link_count}

static inline float {name}_clip(float x, float limit)
{{
    return x > limit ? limit : (x < -limit ? -limit : x);
}}

static inline float {name}_sign(float v)
{{
    return {name}_clip(v / {NAME}_SIGN_WIDTH, 1.0f);
}}

/* out = a x b, added to what is there. */
static inline void {name}_cross(const float a[3], const float b[3], float out[3])
{{
    out[0] += a[1] * b[2] - a[2] * b[1];
    out[1] += a[2] * b[0] - a[0] * b[2];
    out[2] += a[0] * b[1] - a[1] * b[0];
}}

/* Forces of the joints [N m or N] at position q, velocity v and acceleration a. */
static inline void {name}_torque(const float q[{NAME}_JOINTS], const float v[{NAME}_JOINTS],
                                 const float a[{NAME}_JOINTS], float torque[{NAME}_JOINTS])
{{
    /* Parent of each link (-1: the base), whether its joint turns, and the joint by which it moves. */
    static const int parent[{NAME}_LINKS] = {{{parents}}};
    static const int turns[{NAME}_LINKS] = {{{turns}}};
    static const int leader[{NAME}_LINKS] = {{{leaders}}};
    static const float ratio[{NAME}_LINKS] = {{{ratios}}};
    /* Frame of each link in its parent's, by rows, and its origin. */
    static const float axes[{NAME}_LINKS][9] = {{{axes}}};
    static const float origin[{NAME}_LINKS][3] = {{{origins}}};
    /* Mass, first moment, and inertia about the origin: xx xy xz yy yz zz. */
    static const float body[{NAME}_LINKS][10] = {{{bodies}}};
    static const float rotor[{NAME}_JOINTS] = {{{rotors}}};
    float turn[{NAME}_LINKS][9], at[{NAME}_LINKS][3];
    float w[{NAME}_LINKS][3], dw[{NAME}_LINKS][3], rise[{NAME}_LINKS][3];
    float force[{NAME}_LINKS][3], moment[{NAME}_LINKS][3];
    const float base[3] = {{{rise}}}, none[3] = {{0.0f, 0.0f, 0.0f}};
    int i, j, k;

    for (k = 0; k < {NAME}_LINKS; ++k) {{
        const float x = ratio[k] * q[leader[k]], xd = ratio[k] * v[leader[k]], xdd = ratio[k] * a[leader[k]];
        const float *w0 = parent[k] < 0 ? none : w[parent[k]], *dw0 = parent[k] < 0 ? none : dw[parent[k]];
        const float *rise0 = parent[k] < 0 ? base : rise[parent[k]], *m = body[k];
        const float c = turns[k] ? cosf(x) : 1.0f, s = turns[k] ? sinf(x) : 0.0f;
        float carried[3], spin[3] = {{0.0f, 0.0f, 0.0f}}, lever[3] = {{0.0f, 0.0f, 0.0f}};

        for (i = 0; i < 3; ++i) {{
            turn[k][3 * i] = c * axes[k][3 * i] + s * axes[k][3 * i + 1];
            turn[k][3 * i + 1] = c * axes[k][3 * i + 1] - s * axes[k][3 * i];
            turn[k][3 * i + 2] = axes[k][3 * i + 2];
            at[k][i] = origin[k][i] + (turns[k] ? 0.0f : x * axes[k][3 * i + 2]);
        }}
        /* Acceleration of the origin as the parent carries it. */
        {name}_cross(w0, at[k], lever);
        for (i = 0; i < 3; ++i) carried[i] = rise0[i];
        {name}_cross(dw0, at[k], carried);
        {name}_cross(w0, lever, carried);
        for (i = 0; i < 3; ++i) {{
            w[k][i] = dw[k][i] = rise[k][i] = 0.0f;
            for (j = 0; j < 3; ++j) {{
                w[k][i] += turn[k][3 * j + i] * w0[j];
                dw[k][i] += turn[k][3 * j + i] * dw0[j];
                rise[k][i] += turn[k][3 * j + i] * carried[j];
            }}
        }}
        spin[2] = turns[k] ? xd : 2.0f * xd;
        {name}_cross(w[k], spin, turns[k] ? dw[k] : rise[k]);
        if (turns[k]) {{
            w[k][2] += xd;
            dw[k][2] += xdd;
        }} else {{
            rise[k][2] += xdd;
        }}
        /* Force and moment about the origin that move the body. */
        {{
            const float *first = m + 1;
            float along[3] = {{0.0f, 0.0f, 0.0f}};
            float swirl[3] = {{m[4] * w[k][0] + m[5] * w[k][1] + m[6] * w[k][2],
                              m[5] * w[k][0] + m[7] * w[k][1] + m[8] * w[k][2],
                              m[6] * w[k][0] + m[8] * w[k][1] + m[9] * w[k][2]}};
            for (i = 0; i < 3; ++i) force[k][i] = m[0] * rise[k][i];
            {name}_cross(dw[k], first, force[k]);
            {name}_cross(w[k], first, along);
            {name}_cross(w[k], along, force[k]);
            moment[k][0] = m[4] * dw[k][0] + m[5] * dw[k][1] + m[6] * dw[k][2];
            moment[k][1] = m[5] * dw[k][0] + m[7] * dw[k][1] + m[8] * dw[k][2];
            moment[k][2] = m[6] * dw[k][0] + m[8] * dw[k][1] + m[9] * dw[k][2];
            {name}_cross(w[k], swirl, moment[k]);
            {name}_cross(first, rise[k], moment[k]);
        }}
    }}
    for (j = 0; j < {NAME}_JOINTS; ++j) torque[j] = rotor[j] * a[j];
    for (k = {NAME}_LINKS - 1; k >= 0; --k) {{
        torque[leader[k]] += ratio[k] * (turns[k] ? moment[k][2] : force[k][2]);
        if (parent[k] >= 0) {{
            float push[3] = {{0.0f, 0.0f, 0.0f}};
            for (i = 0; i < 3; ++i)
                for (j = 0; j < 3; ++j) push[i] += turn[k][3 * i + j] * force[k][j];
            for (i = 0; i < 3; ++i) {{
                force[parent[k]][i] += push[i];
                for (j = 0; j < 3; ++j) moment[parent[k]][i] += turn[k][3 * i + j] * moment[k][j];
            }}
            {name}_cross(at[k], push, moment[parent[k]]);
        }}
    }}
    /* Friction, springs and what else was found at the joints. */
{forces}}}

/* Commands of the drives that give the same motion. */
static inline void {name}_command(const float q[{NAME}_JOINTS], const float v[{NAME}_JOINTS],
                                  const float a[{NAME}_JOINTS], float command[{NAME}_DRIVES])
{{
    float torque[{NAME}_JOINTS];
    {name}_torque(q, v, a, torque);
{commands}}}

#endif
"""


def export_c(model: Mapping[str, Any], stem: str, version: str, where: str) -> ExportedFile:
    """Write a C header with the forces and commands that a motion needs, friction included.

    Args:
        model: `model` of result.json.
        stem: Name of the file without its suffix; functions begin with it.
        version: That of jaxid.
        where: The result, for messages.

    Source:
        Recursive Newton-Euler algorithm; Featherstone (2008), Rigid Body Dynamics Algorithms, section 5.3.
    """
    plain, name = PlainTree.of(model, where), identifier(stem)
    own = {"sign": f"{name}_sign", "clip": f"{name}_clip"}
    language = Language({**_C, **own}, "f")
    laws = written(model, language, plain.field)

    def row(values: Iterable[float]) -> str:
        return ", ".join(language.number(float(v)).strip("()") for v in values)

    def rows(matrix: np.ndarray) -> str:
        lines = ",\n        ".join("{" + row(r) + "}" for r in matrix.reshape(len(matrix), -1))
        return f"\n        {lines}"

    forces = "".join(
        f"    torque[{joint}] += {term};\n" for joint, terms in enumerate(laws.forces) for term in terms
    )
    commands = ""
    for drive, (joint, gain) in enumerate(zip(plain.drives, plain.gains, strict=True)):
        steps = "".join(f" f = {step};" for step in laws.commands[joint])
        last = f"command[{drive}] = f / {language.number(gain)};"
        commands += f"    {{ float f = torque[{joint}];{steps} {last} }}\n"
    remarks = "".join(f" * Not in it: {note}.\n" for note in laws.notes)
    text = _HEADER.format(
        title=_in_comment(stem),
        version=version,
        name=name,
        NAME=name.upper(),
        joints=_in_comment(", ".join(plain.names)),
        remarks=_in_comment(remarks),
        joint_count=len(plain.names),
        drive_count=len(plain.drives),
        link_count=len(plain.links),
        parents=", ".join(map(str, plain.parents)),
        turns=", ".join(str(int(t)) for t in plain.revolute),
        leaders=", ".join(map(str, plain.leaders)),
        ratios=row(plain.ratios),
        axes=rows(plain.axes),
        origins=rows(plain.origins),
        bodies=rows(plain.bodies),
        rotors=row(plain.rotors),
        rise=row(-plain.gravity),
        forces=forces,
        commands=commands,
    )
    return ExportedFile(text.encode(), plain.names, laws.notes, laws.lost)


def _in_comment(text: str) -> str:
    """Return a text that does not end the comment in which it stands."""
    return text.replace("*/", "* /")
