// Projection of a world point to clip coordinates through the lens (formulas of cameras/camera/lens.py).
uniform mat4 clip;                // from the world; with distortion from the optical frame
uniform mat4 optical_from_world;
uniform int lens;                 // 0 ideal, 1 plumb_bob and rational_polynomial, 2 equidistant
uniform float k[8];
uniform float valid_radius;       // of the lens, in the normalised image plane
uniform float near;
out float gl_ClipDistance[1];
invariant gl_Position;
vec2 through_lens(vec2 n) {
    float r2 = dot(n, n);
    if (lens == 2) {
        float r = sqrt(r2);
        float angle = atan(r), a2 = angle * angle;
        float distorted = angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))));
        return r > 1e-6 ? n * (distorted / r) : n;
    }
    float radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])));
    vec2 tangential = vec2(k[2], k[3]).yx * (r2 + 2.0 * n * n) + 2.0 * n.x * n.y * vec2(k[2], k[3]);
    return n * radial + tangential;
}
vec4 projected(vec3 world) {
    if (lens == 0) {
        gl_ClipDistance[0] = 1.0;
        return clip * vec4(world, 1.0);
    }
    vec3 p = (optical_from_world * vec4(world, 1.0)).xyz;
    gl_ClipDistance[0] = valid_radius * p.z - length(p.xy);
    float z = max(p.z, near);
    vec2 n = p.xy / z;
    n *= min(1.0, valid_radius / max(length(n), 1e-9));
    vec4 position = clip * vec4(through_lens(n) * z, z, 1.0);
    position.z += clip[2].z * (p.z - z);  // clips points before the near plane
    return position;
}
