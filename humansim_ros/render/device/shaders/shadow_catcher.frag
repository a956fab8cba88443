#version 330
// Visible share of the sun on the invisible ground z = 0, shaded by the static scene.
uniform sampler2D rays;           // x and y of each pixel's ray where z is 1, optical frame
uniform mat4 world_from_optical;
out float visibility;
void main() {
    vec3 ray = mat3(world_from_optical) * vec3(texelFetch(rays, ivec2(gl_FragCoord.xy), 0).xy, 1.0);
    float z = -world_from_optical[3].z / ray.z;
    visibility = z > 0.0 ? sun_visibility(static_shadows, static_depths, static_map, world_from_optical[3].xyz + ray * z, vec3(0.0, 0.0, 1.0)) : 1.0;
}
