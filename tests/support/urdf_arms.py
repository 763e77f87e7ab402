"""URDF files of random arms, as text: tests write them and give them to jaxid and to Pinocchio alike."""

import numpy as np

HEAD = '<?xml version="1.0"?>\n<robot name="arm">\n'


def words(values) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def link(name: str, rng: np.random.Generator | None) -> str:
    """A link; without a generator it has no inertial."""
    if rng is None:
        return f'<link name="{name}"/>\n'
    points, m = rng.uniform(-0.2, 0.2, (20, 3)), rng.uniform(0.05, 0.4, 20)
    points -= m @ points / m.sum()
    spread = np.einsum("p,pi,pj->ij", m, points, points)
    xx, xy, xz, _, yy, yz, _, _, zz = np.ravel(np.trace(spread) * np.eye(3) - spread)
    tensor = dict(ixx=xx, ixy=xy, ixz=xz, iyy=yy, iyz=yz, izz=zz)
    inertia = " ".join(f'{k}="{float(v)!r}"' for k, v in tensor.items())
    return (
        f'<link name="{name}"><inertial>{origin(rng)}<mass value="{float(m.sum())!r}"/>'
        f"<inertia {inertia}/></inertial></link>\n"
    )


def origin(rng: np.random.Generator) -> str:
    return f'<origin xyz="{words(rng.uniform(-0.4, 0.4, 3))}" rpy="{words(rng.uniform(-3, 3, 3))}"/>'


def joint(name: str, kind: str, parent: str, child: str, rng: np.random.Generator, axis=None) -> str:
    axis = rng.normal(size=3) if axis is None else axis
    return (
        f'<joint name="{name}" type="{kind}">{origin(rng)}<parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{words(np.asarray(axis) / np.linalg.norm(axis))}"/>'
        '<limit lower="-2" upper="2" effort="10" velocity="1"/></joint>\n'
    )


def arm(kinds, seed: int = 0, axes=None) -> str:
    """A chain of joints of these kinds: link k is moved, or held, by joint k, and both stand out of order."""
    rng = np.random.default_rng(seed)
    links = [link("base", rng), *(link(f"link{k}", rng) for k in range(1, len(kinds) + 1))]
    joints = [
        joint(
            f"joint{k}",
            kind,
            "base" if k == 1 else f"link{k - 1}",
            f"link{k}",
            rng,
            None if axes is None else axes[k - 1],
        )
        for k, kind in enumerate(kinds, start=1)
    ]
    return HEAD + "".join([*rng.permutation(joints), *rng.permutation(links)]) + "</robot>\n"
