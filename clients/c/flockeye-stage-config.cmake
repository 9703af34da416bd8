# find_package(flockeye-stage) gives the target flockeye::stage.
get_filename_component(FLOCKEYE_PREFIX "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
if(NOT TARGET flockeye::stage)
    add_library(flockeye::stage SHARED IMPORTED)
    set_target_properties(flockeye::stage PROPERTIES
        IMPORTED_LOCATION "${FLOCKEYE_PREFIX}/lib/libflockeye_stage.so"
        IMPORTED_NO_SONAME TRUE
        INTERFACE_INCLUDE_DIRECTORIES "${FLOCKEYE_PREFIX}/include")
endif()
