#version 330
// A surface in the world.
in vec3 position;
in vec3 normal;
in vec2 uv;
in vec3 color;
uniform vec4 optical_z;  // third row of the world-to-optical transform
out vec4 v_normal;       // w: depth, to interpolate one vector less
out vec2 v_uv;
out vec3 v_color;
#if defined(STATIC_SHADOWS) || defined(PBR)
out vec3 v_world;
#endif
#ifdef STATIC_SCENE
in float layer;
flat out float v_layer;
#endif
#ifdef AMBIENT_OCCLUSION
in vec2 light_uv;
out vec2 v_light_uv;
#endif
#ifdef SKIN_AND_CLOTH
uniform vec3 eye;
uniform vec3 sun;
out vec3 v_terms;  // specular of the sun, specular of ambient light, roughness of cloth
#endif
void main() {
    gl_Position = projected(position);
    v_normal = vec4(normal, dot(optical_z, vec4(position, 1.0)));
    v_uv = uv;
    v_color = color;
#if defined(STATIC_SHADOWS) || defined(PBR)
    v_world = position;
#endif
#ifdef STATIC_SCENE
    v_layer = layer;
#endif
#ifdef AMBIENT_OCCLUSION
    v_light_uv = light_uv;
#endif
#ifdef SKIN_AND_CLOTH
    v_terms = skin_and_cloth_terms(normal, normalize(eye - position), sun);
#endif
}
