/* Types and functions of FMI 2.0 for co-simulation, after the standard (fmi-standard.org), version 2.0. */

#ifndef FMI2_INTERFACE_H
#define FMI2_INTERFACE_H

#include <stddef.h>

#if defined(_WIN32)
#define EXPORTED __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORTED __attribute__((visibility("default")))
#else
#define EXPORTED
#endif

typedef void *instance_t;
typedef void *environment_t;
typedef void *saved_t;
typedef unsigned int reference_t;
typedef int bool_t;
typedef enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING } status_t;

typedef struct {
    void (*log)(environment_t environment, const char *name, status_t status, const char *category, const char *text, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*finished)(environment_t environment, status_t status);
    environment_t environment;
} callbacks_t;

#endif
